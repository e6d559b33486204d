"""Studies: identification, accuracy, speed, ex-vivo protocol, data sets, and their charts and reports."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.study.bench import benchmark
    from echospline.study.calibrate import IN_PLANE, PRINTED, calibrate
    from echospline.study.charts_exvivo import error_per_depth, motion_maps
    from echospline.study.dataset import (
        create_store,
        make_sample,
        sample_arrays,
        sample_bytes,
        write_summary,
    )
    from echospline.study.exvivo import Fit, Regions, compared, fit, regions, tracker_error
    from echospline.study.identify import Identification, identify
    from echospline.study.paper import FULL, QUICK, study
    from echospline.study.report import figure, paragraph, table, write_report
    from echospline.study.sweep import Task, sweep
    from echospline.study.unit_fields import ForceFields, Observation, SplineFields, UnitFields
else:
    on_demand(__name__)

__all__ = [
    "FULL",
    "IN_PLANE",
    "PRINTED",
    "QUICK",
    "Fit",
    "ForceFields",
    "Identification",
    "Observation",
    "Regions",
    "SplineFields",
    "Task",
    "UnitFields",
    "benchmark",
    "calibrate",
    "compared",
    "create_store",
    "error_per_depth",
    "figure",
    "fit",
    "identify",
    "make_sample",
    "motion_maps",
    "paragraph",
    "regions",
    "sample_arrays",
    "sample_bytes",
    "study",
    "sweep",
    "table",
    "tracker_error",
    "write_report",
    "write_summary",
]
