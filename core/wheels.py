"""Build the wheel of every platform from this machine, by zig, and the source distribution; check them; run the one for here.

Needs hatchling and ziglang in the running interpreter (`make setup` installs them). Results are in dist/.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import build

DIST = build.ROOT / "dist"
GLIBC = (2, 17)  # manylinux_2_17
STEP = """
import ctypes
from echospline import _native as native

core = native.library()
options = native.SceneOptions(struct_size=ctypes.sizeof(native.SceneOptions))
core.echospline_scene_defaults(options)
options.shape[:2], options.spacing[:2] = (40, 30), (1.0, 1.0)
scene, tissue = ctypes.c_void_p(), ctypes.c_void_p()
native.check(core.echospline_scene_create(options, scene), core.echospline_scene_message, scene)
native.check(core.echospline_tissue_create(scene, tissue), core.echospline_tissue_message, tissue)
pose = native.Pose(entry=(8, 0, 0), tip=(16, 12, 0), speed=10, dt=0.1)
native.check(core.echospline_advance(tissue, pose), core.echospline_tissue_message, tissue)
field = (ctypes.c_double * (2 * core.echospline_scene_node_count(scene)))()
native.check(core.echospline_displacement(tissue, field, len(field)), core.echospline_tissue_message, tissue)
core.echospline_tissue_destroy(tissue)
core.echospline_scene_destroy(scene)
level = core.echospline_level_name(core.echospline_level_best()).decode()
print(f"a step at level {level} displaces by {max(map(abs, field)):.3f} mm")
"""


def wheel(name: str) -> Path:
    """Build one platform's wheel and return it."""
    before = set(DIST.glob("*.whl"))
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(DIST)]
    environment = {
        **os.environ,
        "ECHOSPLINE_TARGET": name,
        "ECHOSPLINE_WASM": "1",
        "SOURCE_DATE_EPOCH": "1577836800",
    }
    subprocess.run(command, cwd=build.ROOT, env=environment, check=True)
    (path,) = set(DIST.glob("*.whl")) - before
    return path


def glibc_needed(library: bytes) -> tuple[int, int]:
    """Newest glibc whose symbols an ELF library asks for; the version names stand in its string table."""
    versions = [(int(major), int(minor)) for major, minor in re.findall(rb"GLIBC_(\d+)\.(\d+)", library)]
    return max(versions, default=(0, 0))


def check(path: Path, target: build.Target) -> None:
    """Refuse a wheel that lacks something, or asks for a newer system than its name says."""
    native = "echospline/_native/"
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        library = archive.read(native + target.library)
    wanted = {native + file for file in (target.library, "echospline.wasm", "echospline.js", "__init__.py")}
    wanted |= {"echospline/data/calf.png", "echospline/data/demo.toml", "echospline/viewer/static/index.html"}
    wanted |= {"echospline/data/spine.mha", "echospline/data/spine.LICENSE"}
    if missing := wanted - names:
        raise build.BuildError(f"{path.name} lacks {', '.join(sorted(missing))}")
    libraries = {
        name for name in names if name.startswith(native) and name.endswith((".so", ".dylib", ".dll"))
    }
    if libraries != {native + target.library}:
        raise build.BuildError(f"{path.name} must hold one library; it holds {', '.join(sorted(libraries))}")
    magic = {
        "libechospline.so": b"\x7fELF",
        "libechospline.dylib": b"\xcf\xfa\xed\xfe",
        "echospline.dll": b"MZ",
    }
    if not library.startswith(magic[target.library]):
        raise build.BuildError(f"{path.name} holds a library of another system")
    if not path.stem.endswith(f"-py3-none-{target.wheel_tag}"):
        raise build.BuildError(f"{path.name} must be tagged py3-none-{target.wheel_tag}")
    if target.library.endswith(".so") and (needed := glibc_needed(library)) > GLIBC:
        raise build.BuildError(
            f"{path.name} needs glibc {needed[0]}.{needed[1]}; its tag says {GLIBC[0]}.{GLIBC[1]}"
        )
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB, library {len(library) / 1000:.0f} kB")


def try_out(path: Path) -> None:
    """Install a wheel into a clean environment, run the program and one step of the core."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        binaries = Path(folder, "Scripts" if sys.platform == "win32" else "bin")
        quiet = ["--quiet", "--disable-pip-version-check"]
        subprocess.run([binaries / "python", "-m", "pip", "install", *quiet, path], cwd=folder, check=True)
        subprocess.run([binaries / "echospline", "--help"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        subprocess.run([binaries / "python", "-c", STEP], cwd=folder, check=True)


def main() -> int:
    """Build, check and try out."""
    DIST.mkdir(exist_ok=True)
    for old in (*DIST.glob("*.whl"), *DIST.glob("*.tar.gz")):
        old.unlink()
    here = build.this_machine()
    try:
        subprocess.run(
            [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(DIST)],
            cwd=build.ROOT,
            check=True,
        )
        for name, target in build.TARGETS.items():
            path = wheel(name)
            check(path, target)
            if (target.architecture, target.library) == (here.architecture, here.library):
                try_out(path)
    except (build.BuildError, subprocess.CalledProcessError) as error:
        print(f"wheels: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
