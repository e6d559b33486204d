"""Node as tests run it."""

from __future__ import annotations

import shutil

NODE = shutil.which("node")
STEADY = "--single-threaded"
"""Compilers of V8 without threads: with them one run in thirty of Node 20 stands still when it ends (nodejs/node issue 54918)."""
