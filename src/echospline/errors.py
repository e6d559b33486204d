"""One small tree of exceptions; each message gives the expectation, the input and the remedy."""

from __future__ import annotations


class EchosplineError(Exception):
    """Base of every exception that echospline raises."""


class InputError(EchosplineError, ValueError):
    """A file, an option or an argument is invalid; the command line exits with code 2."""


class ProtocolError(InputError):
    """Bytes from the network break the protocol; their sender is at fault."""


class FoldingError(EchosplineError):
    """A deformation folds the image over itself (Jacobian <= 0) and the caller asked for an error."""


class SolverError(EchosplineError):
    """A linear system cannot be solved to the promised accuracy; the message names the landmarks or elements."""


class MissingExtraError(EchosplineError, ImportError):
    """An optional dependency is not installed; the message holds the command that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed; "
            f"run: pip install 'echospline[{extra}]'"
        )
