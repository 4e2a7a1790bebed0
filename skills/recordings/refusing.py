"""Refuse in words what makes a library fail: on a damaged file it may raise anything at all."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from skills.errors import SkillsError, UnreadableRecording

_LIMITS = (errno.EFBIG, errno.ENOSPC)


@contextmanager
def refusing(what: str, advice: str) -> Iterator[None]:
    """Turn what a library raises into a refusal; a limit of this process that is reached stays what it is.

    Args:
        what: What was being read, as a sentence starts.
        advice: What to do about it, as a sentence.

    Raises:
        UnreadableRecording: Anything else was raised.
    """
    try:
        yield
    except (SkillsError, MemoryError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _LIMITS:
            raise
        raise UnreadableRecording(f"{what} is truncated or corrupt ({type(error).__name__}). {advice}") from error
