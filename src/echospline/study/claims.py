"""The paper's claims, each against the numbers of a study: the pairings under which it holds, and those under which it does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

Row = Mapping[str, Any]


def claims(accuracy: Sequence[Row], savings: Sequence[Row]) -> list[dict[str, str]]:
    """Judge the claims of the paper.

    Parameters
    ----------
    accuracy : sequence of rows
        Of `study.accuracy.accuracy`, with ``reading`` and ``label`` for the four moduli.
    savings : sequence of rows
        Of `study.speed.savings`.

    Returns
    -------
    list of dict
        ``claim``, ``verdict``, ``evidence``.
    """
    judged = []
    if savings:
        judged += [_faster(savings), _consistently(savings)]
    moduli = [row for row in accuracy if row.get("reading")]
    if moduli:
        judged += [_similar(moduli), _grows(moduli), _below(moduli)]
    return judged


def _faster(savings: Sequence[Row]) -> dict[str, str]:
    tps = [row for row in savings if row["method"].startswith("TPS")]
    holds = [row for row in tps if row["mean_saving_percent"] >= 50.0]
    return {
        "claim": "TPS is on average 51.8 % faster than FEM, 500 to 4500 nodes",
        "verdict": _verdict(len(holds), len(tps)),
        "evidence": "; ".join(
            f"{method}: "
            + ", ".join(
                f"{row['mean_saving_percent']:+.0f} % against {row['against'].removeprefix('FEM, ')}"
                for row in tps
                if row["method"] == method
            )
            for method in dict.fromkeys(row["method"] for row in tps)
        )
        + ". Negative: TPS takes longer.",
    }


def _consistently(savings: Sequence[Row]) -> dict[str, str]:
    tps = [row for row in savings if row["method"].startswith("TPS")]
    holds = [row for row in tps if row["least_saving_percent"] > 0.0]
    return {
        "claim": "TPS is consistently faster than FEM, on every mesh",
        "verdict": _verdict(len(holds), len(tps)),
        "evidence": "faster on every mesh: "
        + (
            "; ".join(
                f"{method} against "
                + ", ".join(r["against"].removeprefix("FEM, ") for r in holds if r["method"] == method)
                for method in dict.fromkeys(row["method"] for row in holds)
            )
            or "no pair"
        ),
    }


def _similar(moduli: Sequence[Row]) -> dict[str, str]:
    ours = [row for row in moduli if row["model"] == "tps" and row["how"] == "fitted"]
    percent = {
        (kernel, out): [
            r["mae_percent_of_mean"] for r in ours if r["kernel"] == kernel and r["held_out"] is out
        ]
        for kernel in ("thin plate", "elastic")
        for out in (False, True)
    }
    thin = percent["thin plate", True]
    return {
        "claim": "TPS and FEM displace the mesh alike once TPS is tuned; the error is negligible",
        "verdict": "holds" if max(thin) < 5.0 else "does not hold",
        "evidence": "mean error as a share of the mean FEM displacement, "
        + "; ".join(
            f"{kernel}, {'held-out' if out else 'fitted'} insertions: {_span(values)} %"
            for (kernel, out), values in percent.items()
            if values
        ),
    }


def _grows(moduli: Sequence[Row]) -> dict[str, str]:
    series = _thin_plate(moduli)
    grows = all(
        a["mae_mm"] <= b["mae_mm"]
        for rows in series.values()
        for a, b in pairwise(sorted(rows, key=lambda row: -row["young_kpa"]))
    )
    shares = [row["mae_percent_of_mean"] for rows in series.values() for row in rows]
    return {
        "claim": "The error grows as Young's modulus falls",
        "verdict": "holds" if grows else "does not hold",
        "evidence": "in mm, for the displacement grows as 1 / E; as a share of the mean displacement it is "
        f"{_span(shares)} %",
    }


def _below(moduli: Sequence[Row]) -> dict[str, str]:
    lines = []
    verdicts = []
    for reading, rows in _thin_plate(moduli).items():
        worst = max(row["mae_mm"] for row in rows)
        lines.append(f"moduli {reading}: largest MAE {worst:.3g} mm = {worst / 1000:.2g} m")
        verdicts.append(worst / 1000 < 1e-3)
    return {
        "claim": "The error stays under 10^-3 (no unit given)",
        "verdict": f"{'holds' if all(verdicts) else 'holds for some readings' if any(verdicts) else 'does not hold'}"
        " if metres are meant; does not hold in millimetres",
        "evidence": "; ".join(lines),
    }


def _thin_plate(moduli: Sequence[Row]) -> dict[str, list[Row]]:
    """Select the fitted thin-plate rows on the fitted insertion, as in the paper, by reading of the moduli."""
    rows = [
        r
        for r in moduli
        if (r["model"], r["kernel"], r["how"]) == ("tps", "thin plate", "fitted") and not r["held_out"]
    ]
    return {
        reading: [r for r in rows if r["reading"] == reading]
        for reading in dict.fromkeys(r["reading"] for r in rows)
    }


def _span(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"


def _verdict(holds: int, pairs: int) -> str:
    if holds in (0, pairs):
        return "holds for every pairing" if holds else "does not hold"
    return f"holds for {holds} of {pairs} pairings"
