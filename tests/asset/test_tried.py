"""Which layers a child process opens before we do."""

from __future__ import annotations

import pytest

from usdbrdf.asset.readers import tried
from usdbrdf.asset.readers.tried import try_layers, wrote


@pytest.fixture
def asked(monkeypatch):
    """What children were asked to open, one list for each."""
    lists = []
    told = lambda _function, _arrays, task, *_: lists.append(task["layers"])  # noqa: E731
    monkeypatch.setattr(tried, "run_child", told)
    return lists


@pytest.fixture
def layers(tmp_path):
    files = [tmp_path / f"{name}.usda" for name in "abcd"]
    for file in files:
        file.write_text("#usda 1.0\n")
    return files


def test_each_stage_is_tried_once(asked, layers):
    """Layers that are each known from another one are a new stage."""
    a, b, c, d = layers
    for _ in range(2):
        for stage in ([a, b], [c, d], [a, c]):
            try_layers(stage, together=True)
    assert asked == [[str(a), str(b)], [str(c), str(d)], [str(a), str(c)]]
    try_layers(layers)
    assert len(asked) == 3, "alone all are known"


def test_what_we_wrote_makes_no_other_stage(asked, layers):
    a, b, c, _ = layers
    wrote(c)
    try_layers([c], together=True)
    assert asked == []
    for stage in ([a, b], [c, a, b]):
        try_layers(stage, together=True)
    assert asked == [[str(a), str(b)]]
    try_layers([c, a, b])
    assert len(asked) == 1


def test_a_layer_that_goes_while_it_is_looked_at_is_not_there(asked, layers, monkeypatch):
    a, b = layers[:2]
    kind = type(a)
    is_file = kind.is_file

    def going(file, **options):
        there = is_file(file, **options)
        if file == b and there:
            b.unlink()
        return there

    monkeypatch.setattr(kind, "is_file", going)
    try_layers([a, b])
    assert asked == [[str(a)]]
    wrote(b)
