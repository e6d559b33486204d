"""Contact sheet of a needle's echo: in the plane at several tilts, across it, askew, and with a curved array, on the calf sample.

Usage: python benchmarks/needle_sheet.py [needle_sheet.png [share]]; docs/images/needle.png is made with a share of 0.5 of the size.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "core"))
import native

SAMPLE = Path(__file__).resolve().parents[1] / "src/echospline/data/calf.png"
SPACING = 0.0866  # mm
IN_PLANE = (
    (0, 34),
    (5, 36),
    (10, 36),
    (15, 37),
    (20, 35),
    (30, 32),
    (50, 28),
    (75, 28),
    (88, 25),
)  # degrees, mm
THROUGH = (
    ("across, square", (0, 0, 1)),
    ("across, 45 steep", (0, 1, 1)),
    ("across, 70 steep", (0, 2.7, 1)),
    ("askew, 45 flat", (0.7, 0.1, 0.7)),
    ("askew, 7 out of plane", (0.8, 0.5, 0.12)),
)
PER_ROW = 3


def needles() -> list[tuple[str, Any]]:
    """Return labels and needles."""
    found = []
    for tilt, length in IN_PLANE:
        a = np.radians(tilt)
        entry = np.array([5 if tilt < 60 else 18, 0.5 if tilt >= 15 else 8, 0])
        found.append(
            (f"in plane, {tilt}", native.needle(entry, entry + length * np.array([np.cos(a), np.sin(a), 0])))
        )
    for label, way in THROUGH:
        u = np.array(way) / np.linalg.norm(way)
        found.append((label, native.needle((25, 15, 0) - 20 * u, (25, 15, 0) + 20 * u)))
    entry, a = np.array([5, 0.5, 0]), np.radians(30)
    tip = entry + 32 * np.array([np.cos(a), np.sin(a), 0])
    found.append(("curved array, 30", native.needle(entry, tip, curved=1, apex=(25, -40))))
    return found


def main(path: str = "needle_sheet.png", share: float = 1.0) -> None:
    """Write the sheet."""
    calf = cv2.imread(str(SAMPLE), cv2.IMREAD_GRAYSCALE)
    picture = native.Picture(calf, (30, 24), spacing=(SPACING, SPACING), origin=(SPACING / 2, SPACING / 2))
    tiles = [cv2.putText(picture.draw(n), text, (240, 445), 0, 0.8, 255, 2) for text, n in needles()]
    rows = [np.hstack(tiles[k : k + PER_ROW]) for k in range(0, len(tiles), PER_ROW)]
    sheet = cv2.resize(np.vstack(rows), None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    cv2.imwrite(path, sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main(*sys.argv[1:2], *(float(share) for share in sys.argv[2:]))
