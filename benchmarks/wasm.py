"""Step and whole frame of the core in WebAssembly (node) against the native core, in one run.

    python benchmarks/wasm.py [--repeats 5]

A push at 10 mm/s drawn at 60 Hz, 512 x 512 pixels of 8 bits with the needle, one thread; medians of the last quarter in ms, the
least over the repeats. Needs node and `make wasm`.
"""

import argparse
import ctypes
import json
import subprocess
from pathlib import Path
from time import perf_counter

import numpy as np

from echospline import _native as core

MESHES = [(40, 30), (78, 58)]
SIZE = 512


def native(shape):
    """Median ms of step and frame in the native core."""
    lib = core.library()
    spacing = (40 / (shape[0] - 1), 30 / (shape[1] - 1))
    o = core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions), dimension=2)
    lib.echospline_scene_defaults(ctypes.byref(o))
    o.delta, o.contact_spacing = 1.1, 1.0
    p = core.PictureOptions(struct_size=ctypes.sizeof(core.PictureOptions))
    lib.echospline_picture_defaults(ctypes.byref(p))
    p.columns = p.rows = SIZE
    for d, extent in enumerate((40.0, 30.0)):
        o.shape[d] = p.mesh_shape[d] = shape[d]
        o.spacing[d] = p.mesh_spacing[d] = spacing[d]
        p.spacing[d] = extent / (SIZE - 1)
    scene, tissue, picture = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
    pixels = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE), dtype=np.uint8)
    out = np.empty_like(pixels)
    core.check(
        lib.echospline_scene_create(ctypes.byref(o), ctypes.byref(scene)), lib.echospline_scene_message, scene
    )
    core.check(
        lib.echospline_tissue_create(scene, ctypes.byref(tissue)), lib.echospline_tissue_message, tissue
    )
    made = lib.echospline_picture_create(ctypes.byref(p), pixels.ctypes.data, ctypes.byref(picture))
    core.check(made, lib.echospline_picture_message, picture)
    needle = core.Needle(struct_size=ctypes.sizeof(core.Needle))
    lib.echospline_needle_defaults(ctypes.byref(needle))
    pose, steps, frames, dt = core.Pose(), [], [], 1 / 60
    pose.speed, pose.dt, pose.entry[0], needle.entry[0] = 10.0, dt, 12.3, 12.3
    for i in range(1, 157):
        depth = i * dt * 10
        pose.tip[0] = needle.tip[0] = 12.3 + 0.4 * depth
        pose.tip[1] = needle.tip[1] = np.sqrt(1 - 0.16) * depth
        begin = perf_counter()
        status = lib.echospline_advance(tissue, ctypes.byref(pose))
        between = perf_counter()
        status += lib.echospline_picture_follow(picture, tissue)
        status += lib.echospline_picture_draw(picture, ctypes.byref(needle), out.ctypes.data, out.nbytes)
        end = perf_counter()
        if status:
            raise SystemExit("a call of the native core failed")
        if i > 117:
            steps.append(between - begin)
            frames.append(end - begin)
    level = lib.echospline_level_name(lib.echospline_scene_level(scene)).decode()
    lib.echospline_picture_destroy(picture)
    lib.echospline_tissue_destroy(tissue)
    lib.echospline_scene_destroy(scene)
    return {"step": 1e3 * np.median(steps), "frame": 1e3 * np.median(frames)}, level


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    here = Path(__file__).resolve().parent
    wasm = here.parent / "src" / "echospline" / "_native" / "echospline.wasm"
    if not wasm.exists():
        raise SystemExit(f"expected {wasm}; it is not there: run make wasm")
    best = [{}, {}]
    for _ in range(repeats):
        for i, shape in enumerate(MESHES):
            found, level = native(shape)
            best[i] = {k: min(v, best[i].get(k, np.inf)) for k, v in found.items()}
        command = ["node", here / "wasm.mjs", wasm, json.dumps(MESHES)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        for i, row in enumerate(json.loads(done.stdout)):
            for k, v in row.items():
                best[i][f"wasm {k}"] = min(v, best[i].get(f"wasm {k}", np.inf))
    print(f"native level {level}, one thread, least of {repeats} medians, ms")
    for shape, row in zip(MESHES, best, strict=True):
        for what in ("step", "frame"):
            ratio = row[f"wasm {what}"] / row[what]
            print(
                f"{shape[0] * shape[1]:6d} nodes  {what:6s} native {row[what]:7.3f}  WebAssembly {row[f'wasm {what}']:7.3f}  {ratio:5.2f} x"
            )


if __name__ == "__main__":
    main()
