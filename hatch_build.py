"""Build hook of the package: compiles the core and puts it into the wheel, or into the source tree of an editable install.

With a C++20 compiler on PATH nothing is fetched; without one the build takes the Python package ziglang, once. WebAssembly needs
ziglang anyway: it is built where ziglang is installed, where it was built from the same sources before (`make wasm`), and on
request: `ECHOSPLINE_WASM=1 pip install .`. ECHOSPLINE_TARGET names another platform of `core/build.py`, for `make wheels`.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "echospline/_native"


def core_build(root: str) -> ModuleType:
    """Import core/build.py from its file."""
    if (module := sys.modules.get("echospline_core_build")) is None:
        spec = importlib.util.spec_from_file_location("echospline_core_build", Path(root, "core", "build.py"))
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


class CoreBuildHook(BuildHookInterface):
    """Compiles core/ for a wheel."""

    def dependencies(self) -> list[str]:
        """Ask for ziglang where it is needed; called before `initialize`, in the build's own environment."""
        core = core_build(self.root)
        wanted = os.environ.get("ECHOSPLINE_WASM") or os.environ.get("ECHOSPLINE_TARGET")
        return [core.ZIG] if wanted or core.system_compiler() is None else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the library, and WebAssembly where that is possible; name the wheel after the platform."""
        core = core_build(self.root)
        name = os.environ.get("ECHOSPLINE_TARGET")
        target = core.TARGETS[name] if name else core.this_machine()
        built = [core.build(target)]
        if core.zig() or os.environ.get("ECHOSPLINE_WASM"):
            built.append(core.build(core.WASM))
        elif kept := core.kept_wasm():
            built.append(kept)
        else:
            self.app.display_warning(
                "core: echospline.wasm is left out, because it is built by the Python package ziglang (100 MB); "
                "to have it: ECHOSPLINE_WASM=1 pip install ."
            )
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{target.wheel_tag}"
        for path in built:
            if version == "editable":
                core.install(path, Path(self.root, "src", PACKAGE))
            else:
                build_data["force_include"][str(path)] = f"{PACKAGE}/{path.name}"
