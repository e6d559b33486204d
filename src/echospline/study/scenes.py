"""Each model against finer finite elements where the paper did not look: lesions, layers, and edges that are clamped, slide or are free.

A scene is built by name like any scenario, under the study's needle, and judged like the paper's: fitted on one insertion and
evaluated on the others. A model that refuses a scene has a row that says why.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.mechanics import FEMModel
from echospline.scenario import Scenario, build_model, validated
from echospline.scenario.sections import MeshSection
from echospline.scene import FieldError, RegularGrid, field_error
from echospline.study.accuracy import CLAMPED, FITTED, HELD_OUT, Case, observe
from echospline.study.calibrate import PRINTED
from echospline.study.identify import identify
from echospline.study.unit_fields import Observation, SplineFields

MODELS = ("tps", "elastic", "green", "fem")
FITTED_MODELS = ("tps", "elastic")
FINER = 3
"""The reference is finite elements on a mesh this many times as fine: on the study's own they would be 1 to 2 % off in lesions."""
DEEP = 4.0
"""mm; poses shallower than this are left out of the worst one: next to nothing moves there."""


@dataclass(frozen=True)
class StudyScene:
    """One scene beyond the paper's.

    Parameters
    ----------
    name : str
        For tables.
    regions : sequence of mapping
        Like ``[[tissue.region]]`` of a scenario, in 10 kPa.
    clamped, sliding : tuple of str
        Edges.
    """

    name: str
    regions: Sequence[Mapping[str, Any]] = ()
    clamped: tuple[str, ...] = CLAMPED
    sliding: tuple[str, ...] = ()

    def scenario(self, case: Case) -> Scenario:
        """Return the scenario of the scene under a case's mesh and forces, with the printed laws."""
        mesh: dict[str, Any] = {"nodes": list(case.nodes), "clamped": list(self.clamped)}
        if self.sliding or "sliding" in MeshSection.model_fields:
            mesh["sliding"] = list(self.sliding)
        forces = {"tip": case.forces.tip, "friction": case.forces.friction}
        given = {
            "mesh": mesh,
            "tissue": {"young": case.young, "region": [dict(region) for region in self.regions]},
            "model": {"forces": forces},
        }
        return validated(given, self.name).with_values(PRINTED)


_LESION = {"centre": [24.0, 17.0], "radius": 6.0}
SCENES = (
    StudyScene("the paper's: sides and bottom clamped"),
    StudyScene("lesion of 50 kPa", [{"young": 50.0, "circle": _LESION}]),
    StudyScene("lesion of 2 kPa", [{"young": 2.0, "circle": _LESION}]),
    StudyScene("50 kPa below 12 mm", [{"young": 50.0, "layer": [12.0, 31.0]}]),
    StudyScene("all edges clamped", clamped=("top", *CLAMPED)),
    StudyScene("top slides, the others clamped", sliding=("top",)),
    StudyScene("bottom clamped, sides slide", clamped=("bottom",), sliding=("left", "right")),
    StudyScene("bottom clamped, top slides", clamped=("bottom",), sliding=("top",)),
    StudyScene("bottom alone clamped", clamped=("bottom",)),
    StudyScene("left alone clamped", clamped=("left",)),
)


def scene_rows(**arguments: Any) -> dict[str, Any]:
    """Run one scene: ``scene``, its place in `SCENES`, and ``nodes``, ``steps`` and ``seed`` of `Case`."""
    scene = SCENES[int(arguments["scene"])]
    nx, ny = arguments["nodes"]
    case = Case(name=scene.name, nodes=(int(nx), int(ny)), steps=arguments["steps"], seed=arguments["seed"])
    return {"rows": list(_rows(scene, case))}


def _rows(scene: StudyScene, case: Case) -> Iterator[dict[str, Any]]:
    grid = case.grid
    tissue = StudyScene(scene.name, scene.regions).scenario(case).make_tissue(Path(), grid)
    nx, ny = case.nodes
    fine = replace(case, nodes=(FINER * (nx - 1) + 1, FINER * (ny - 1) + 1))
    fem = FEMModel(fine.grid, scene.clamped, tissue, case.forces, sliding=scene.sliding)
    pick = np.arange(fine.grid.size).reshape(fine.nodes[::-1])[::FINER, ::FINER].ravel()
    observed = (observe(fem, *case.poses(trajectory)) for trajectory in (FITTED, *HELD_OUT))
    seen, *others = (Observation(grid.nodes, o.displacement[:, pick], o.times, o.poses) for o in observed)
    for kind in MODELS:
        how = "fitted" if kind in FITTED_MODELS else "nothing fitted"
        row = {"scene": scene.name, "model": kind, "how": how}
        try:
            model = _built(scene.scenario(case), kind, grid, seen, case.seed)
        except InputError as refusal:
            yield {**row, "held_out": None, "refused": str(refusal)}
            continue
        for held_out, truths in ((False, [seen]), (True, others)):
            fields = [observe(model, o.times, o.poses).displacement for o in truths]
            joint = field_error(np.concatenate(fields), np.concatenate([o.displacement for o in truths]))
            yield {**row, "held_out": held_out, **_numbers(joint, fields, truths), "refused": None}


def _built(scenario: Scenario, kind: str, grid: RegularGrid, seen: Observation, seed: int) -> Any:
    """Build a model for a scene; splines with the parameters that fit one insertion best."""
    model: Any = build_model(scenario, grid, kind=kind)
    if kind not in FITTED_MODELS:
        return model
    found = identify(SplineFields(model, seen), "mae", seed=seed, bootstrap=0)
    fitted = scenario.with_values({f"model.landmarks.{name}": value for name, value in found.values.items()})
    return build_model(fitted, grid, kind=kind)


def _numbers(joint: FieldError, fields: Sequence[Any], truths: Sequence[Observation]) -> dict[str, Any]:
    worst = max(
        field_error(u, v).mae_percent
        for field, truth in zip(fields, truths, strict=True)
        for u, v, pose in zip(field, truth.displacement, truth.poses, strict=True)
        if pose.depth >= DEEP
    )
    return {
        "mae_mm": joint.mae,
        "mae_percent_of_mean": joint.mae_percent,
        "worst_pose_percent": worst,
        "mean_displacement_mm": joint.mean_displacement,
    }
