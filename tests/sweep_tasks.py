"""What the sweep's tests run on workers: importable there."""

import os
import time
from pathlib import Path

from echospline.errors import InputError


def square(x, log=None):
    if log:
        with Path(log).open("a") as file:
            file.write(f"{x}\n")
    return {"y": x * x}


def refuse_odd(x):
    if x % 2:
        raise InputError(f"{x} is odd")
    return {"y": x}


def square_and_die_once(x, grave):
    """The first worker to run task 3 is killed by the kernel, as a machine that fails would be."""
    time.sleep(0.05)
    marker = Path(grave)
    if x == 3 and not marker.exists():
        marker.write_text(str(os.getpid()))
        os.kill(os.getpid(), 9)
    return {"y": x * x, "pid": os.getpid()}
