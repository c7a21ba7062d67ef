"""USD's own words, fit for one of our sentences."""

from __future__ import annotations

from pxr import Tf

_MAX_LENGTH = 300


def in_one_line(error: object) -> str:
    """The text of an error of USD, which often spans lines and repeats itself, on one line.

    Of an exception what its errors say, without the places in USD's own source.
    """
    told = (
        [each.commentary for each in error.args]
        if isinstance(error, Tf.ErrorException)
        else [error]
    )
    text = "; ".join(" ".join(str(part).split()).rstrip(".; ") for part in told)
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ..."
