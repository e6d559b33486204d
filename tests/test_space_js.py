"""Scenes in space by WebAssembly: fields, planes with a needle, tissue under a needle, against Python and the native core."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from echospline.mechanics import NeedleForces, SpatialForceModel
from echospline.mechanics.landmarks import SIDES
from echospline.mechanics.space_response import SpaceResponse, block
from echospline.picture import NeedleEcho
from echospline.picture.slices import STEP, SliceDrawing
from echospline.scene import Probe, SpatialPose, Tissue, probe_plane
from node_here import NODE, STEADY
from test_slices import smooth_volume
from test_spatial_core import session

ROOT = Path(__file__).resolve().parent.parent
WASM = ROOT / "src" / "echospline" / "_native" / "echospline.wasm"

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="Node is not installed: WebAssembly is not compared with Python"),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]


def run(test: str, **environment: str) -> None:
    done = subprocess.run(
        [NODE, STEADY, "--test", "--test-reporter=tap", f"tests/js/{test}"],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "# skipped 0" in done.stdout


def test_webassembly_draws_planes_as_python_does(tmp_path):
    volume = smooth_volume()
    probe = Probe("curved", radius=30.0, opening=50.0, depth=28.0, pixel=0.2, elevation=0.6)
    drawing, plane = SliceDrawing(volume, probe), probe_plane((1.0, 0.0, 1.0), 35.0, 12.0)
    grid, clamps = block((36.0, 36.0, 36.0), {face: "clamped" for face in SIDES if face != "top"})
    response = SpaceResponse(grid, clamps, Tissue(10.0, 0.45), radius=1.5)
    pose = SpatialPose((-9.0, 0.0, -0.5), (0.0, 12.0, 1.0))
    places = np.linspace(pose.entry, pose.tip, 6)[1:]
    field = response.field(places, np.linspace(0.02, 0.2, 5)[:, None] * np.array(pose.axis))
    points = np.random.default_rng(5).uniform([-17, 0, -17], [17, 35, 17], (200, 3))
    echo = NeedleEcho()
    needle = echo.between(pose.entry, pose.tip, apex=probe.apex)
    pictures, reports = {}, {}
    for kind, arguments in {
        "rest": (None, None, None),
        "still": (None, pose, echo),
        "moved": (field, pose, echo),
    }.items():
        drawn = drawing.draw(plane, *arguments)
        pictures[kind] = drawn.image.pixels.ravel().tolist()
        outside = round(drawn.outside * int(probe.mask.sum()))
        reports[kind] = {"residual": drawn.residual * probe.pixel, "outside": outside}
    low, high = grid.corners
    scene = {
        "volume": {"shape": volume.shape, "spacing": volume.spacing, "origin": volume.origin},
        "voxels": volume.voxels.ravel().tolist(),
        "field": {
            "top": 1,
            "poisson": field.poisson,
            "shear_modulus": response.mu,
            "places": field.needle.places.ravel().tolist(),
            "forces": field.needle.forces.ravel().tolist(),
            "radii": field.needle.radii.tolist(),
            "lattice_shape": field.smooth.values.shape[2::-1],
            "lattice_spacing": field.smooth.spacing.tolist(),
            "lattice_origin": field.smooth.origin.tolist(),
            "lattice": field.smooth.values.ravel().tolist(),
        },
        "points": points.ravel().tolist(),
        "displacement": field(points).ravel().tolist(),
        "plane": {
            "columns": probe.grid.shape[0],
            "rows": probe.grid.shape[1],
            "spacing": probe.grid.spacing,
            "origin": probe.grid.origin,
            "step": STEP,
            "mask": probe.mask.astype(int).ravel().tolist(),
            "spread": probe.thickness(probe.grid.y).tolist(),
        },
        "matrix": plane.matrix.ravel().tolist(),
        "needle": {
            name: list(value) if hasattr(value, "__len__") else value
            for name, value in ((f[0], getattr(needle, f[0])) for f in needle._fields_)
            if name != "struct_size"
        },
        "pictures": pictures,
        "reports": reports,
        "spline": {
            "dimension": 3,
            "shape": [9, 9, 9],
            "spacing": ((high - low) / 8).tolist(),
            "origin": low.tolist(),
        },
    }
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(scene), encoding="utf-8")
    run("space.test.js", ECHOSPLINE_SPACE_SCENE=str(path))


def test_webassembly_steps_the_law_as_python_does(tmp_path):
    faces = {
        "left": "clamped",
        "right": "clamped",
        "bottom": "clamped",
        "front": "sliding",
        "back": "free",
        "top": "sliding",
    }
    grid, clamps = block((36.0, 32.0, 30.0), faces)
    response = SpaceResponse(grid, clamps, Tissue(10.0, 0.45), radius=1.5)
    model, points = (
        SpatialForceModel(response, NeedleForces()),
        np.array([[-4.0, 7.0, -1.0], [5.0, 3.0, 3.0]]),
    )
    state, states = model.rest(), []
    for pose in session():
        state = model.advance(state, pose, 0.1)
        load = {name: getattr(state.load, name) for name in ("tip", "friction", "side", "cut")}
        states.append({
            "forces": state.forces.ravel().tolist(),
            "load": {**load, "force": state.force.tolist(), "torque": state.torque.tolist()},
            "displacement": model.field(state)(points).ravel().tolist(),
        })  # fmt: skip
    given = {
        "tables": {name: np.asarray(value).tolist() for name, value in response.tables().items()},
        "poses": [[list(pose.entry), list(pose.tip)] for pose in session()],
        "points": points.ravel().tolist(),
        "states": states,
    }
    path = tmp_path / "session.json"
    path.write_text(json.dumps(given), encoding="utf-8")
    run("spatial.test.js", ECHOSPLINE_SPATIAL=str(path))
