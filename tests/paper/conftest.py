"""The small room of the evaluation's tests."""

from tests.evaluation.conftest import make, room, silence

__all__ = ("make", "room", "silence")
