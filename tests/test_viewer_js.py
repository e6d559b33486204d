"""The page's JavaScript that needs no browser: golden bytes, view, needle; run by Node's own test runner."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from node_here import NODE, STEADY

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.skipif(
    NODE is None, reason="Node is not installed: the page's JavaScript is tested in the browser only"
)
def test_the_pages_javascript_passes_its_own_tests():
    result = subprocess.run(
        [NODE, STEADY, "--test", "--test-reporter=tap", "tests/js/"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "# fail 0" in result.stdout
    assert "# pass 0" not in result.stdout
