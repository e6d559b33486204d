"""Figures: the drawing's geometry is in millimetres and says what the numbers say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.quiver import Quiver
from PIL import Image

from echospline.errors import InputError
from echospline.io import sample_image
from echospline.picture.summary import draw_summary, summary_figure
from echospline.scene import NeedlePose, RegularGrid

IMAGE = sample_image()
MESH = RegularGrid.covering(IMAGE.grid, (40, 30))
POSE = NeedlePose((18.0, 0.0), (30.0, 18.0), 5.0)


def push(mesh: RegularGrid, size: float = 1.5) -> np.ndarray:
    away = ((mesh.nodes - POSE.tip) ** 2).sum(axis=1, keepdims=True)
    return size * np.exp(-away / 60) * np.array(POSE.axis)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same push drawn twice as PNG."""
    folder = tmp_path_factory.mktemp("figures")
    for name in ("one", "two"):
        summary_figure(IMAGE, IMAGE, MESH, push(MESH), POSE, folder / f"{name}.png", title="calf")
    return folder


def test_the_same_run_gives_the_same_figure_and_no_temporary_file(drawn: Path) -> None:
    assert (drawn / "one.png").read_bytes() == (drawn / "two.png").read_bytes()
    assert sorted(p.name for p in drawn.iterdir()) == ["one.png", "two.png"]


def test_the_svg_says_depth_and_largest_displacement(tmp_path: Path) -> None:
    summary_figure(IMAGE, IMAGE, MESH, push(MESH), POSE, tmp_path / "a.svg")
    comments = (tmp_path / "a.svg").read_text(encoding="utf-8")
    ElementTree.fromstring(comments)  # well formed
    largest = np.hypot(*push(MESH).T).max()
    assert f"Displacement, largest {largest:.2f} mm" in comments
    assert f"Needle {np.hypot(12, 18):.1f} mm deep" in comments


def test_the_displaced_place_is_the_bright_one(drawn: Path, tmp_path: Path) -> None:
    summary_figure(IMAGE, IMAGE, MESH, np.zeros((MESH.size, 2)), POSE, tmp_path / "b.png", title="calf")
    with Image.open(drawn / "one.png") as a, Image.open(tmp_path / "b.png") as b:
        assert a.size == b.size
        # cividis runs from blue to yellow: count pixels whose red is well above their blue
        moved, still = (
            int((np.asarray(p.convert("RGB")).astype(int) @ [1, 0, -1] > 90).sum()) for p in (a, b)
        )
    assert moved > still + 2000


def test_everything_is_drawn_where_it_is_in_millimetres() -> None:
    figure = draw_summary(IMAGE, IMAGE, MESH, push(MESH), POSE)
    rest, deformed, field = figure.axes[:3]
    assert rest.images[0].get_extent() == pytest.approx(
        [-0.0433, 49.8383, 39.4463, -0.0433]
    )  # half a pixel around
    assert rest.yaxis_inverted()  # depth grows downwards
    nodes = (MESH.nodes + push(MESH)).reshape(30, 40, 2)
    (lines,) = (c for c in deformed.collections if isinstance(c, LineCollection))
    segments = lines.get_segments()
    assert len(segments) == 70
    np.testing.assert_allclose(segments[11], nodes[11])
    np.testing.assert_allclose(segments[30 + 7], nodes[:, 7])
    (arrows,) = (c for c in field.collections if isinstance(c, Quiver))
    starts = np.column_stack([arrows.X, arrows.Y])
    node = np.linalg.norm(MESH.nodes[None] - starts[:, None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(starts, MESH.nodes[node], atol=1e-9)
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), push(MESH)[node])
    for axes in (deformed, field):
        shaft = np.column_stack(axes.lines[0].get_data())
        np.testing.assert_allclose(shaft, [POSE.entry, POSE.tip])


def test_a_mesh_of_one_node_per_pixel_can_be_drawn(tmp_path: Path) -> None:
    mesh = RegularGrid.covering(IMAGE.grid, IMAGE.grid.shape)
    summary_figure(IMAGE, IMAGE, mesh, push(mesh), POSE, tmp_path / "fine.png")
    assert (tmp_path / "fine.png").stat().st_size > 100_000


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="displacement must be"):
        summary_figure(IMAGE, IMAGE, MESH, push(MESH)[1:], POSE, tmp_path / "a.png")
    with pytest.raises(InputError, match=r"written as \.png"):
        summary_figure(IMAGE, IMAGE, MESH, push(MESH), POSE, tmp_path / "a.jpeg")
    assert list(tmp_path.iterdir()) == []


def test_importing_the_package_and_its_files_does_not_import_matplotlib() -> None:
    code = "import sys, echospline, echospline.io; print(*sorted(m for m in sys.modules if '.' not in m))"
    modules = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"matplotlib", "SimpleITK", "pydicom", "av"} & set(modules)
