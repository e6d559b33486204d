"""One small tree of exceptions; every message says what was expected, what came and what to do."""

from __future__ import annotations


class EchosplineError(Exception):
    """Anything that echospline itself reports."""


class InputError(EchosplineError, ValueError):
    """A file, an option or an argument is not what it must be; the command line exits with code 2."""


class ProtocolError(InputError):
    """Bytes from the network are not what the protocol says; the peer that sent them is at fault."""


class FoldingError(EchosplineError):
    """A deformation folds the image over itself (Jacobian <= 0) and the caller asked to refuse that."""


class SolverError(EchosplineError):
    """A linear system cannot be solved to the accuracy promised; says which landmarks or elements."""


class MissingExtraError(EchosplineError, ImportError):
    """An optional dependency is not installed; the message holds the command that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed; "
            f"run: pip install 'echospline[{extra}]'"
        )
