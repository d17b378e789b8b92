# ruff: noqa: RUF005
"""Labels behave like the tuples of names that they stand for."""

from dirax.schemes.labels import Labels


def test_like_a_tuple():
    labels = Labels.numbered("a {}", 3) + ("one", "with {} in it") + Labels.numbered("b {}", 2)
    names = ("a 0", "a 1", "a 2", "one", "with {} in it", "b 0", "b 1")
    assert tuple(labels) == names and labels == names and len(labels) == 7 and labels[-1] == "b 1"
    for first in range(8):
        for last in range(first, 8):
            assert tuple(labels[first:last]) == names[first:last]
    assert labels[1:6][2:] == names[3:6] and ("x",) + labels[:1] == ("x", "a 0")
    assert len({labels, Labels.numbered("a {}", 3) + ("one", "with {} in it") + Labels.numbered("b {}", 2)}) == 1
    assert "a 2" in labels and len(Labels.numbered("a {}", 10**7)) == 10**7
