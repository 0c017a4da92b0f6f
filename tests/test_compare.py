"""The comparison of methods: options of each."""

import pytest

import raystream as rs
from raystream import compare


def test_options_reach_the_method_of_that_label_only():
    scene, options = rs.scenes.cornell(), {"size": (8, 8), "max_bounces": 0}
    names = ["rsh:levels=1", ("two", "rsh", {"levels": 2}), "rsh:levels=none"]
    results, _ = compare.compare(scene, names, **options, levels=3)
    assert [r.method for r in results] == ["rsh:levels=1", "two", "rsh:levels=none"]
    assert [len(r.frame.statistics.levels) for r in results] == [1, 2, 4]
    (result,), _ = compare.compare(scene, ["rsh"], **options, levels=3)
    assert len(result.frame.statistics.levels) == 3


@pytest.mark.parametrize(("name", "message"), [
    ("fast", "method: need one of .*'embree', got 'fast'"),
    ("rsh:levels", "need key=value"),
    ("rsh:levels=0", "levels: need a whole number"),
    ("brute:levels=2", "method 'brute' has no option 'levels'; its options: none"),
    ("embree:levels=2", "method 'embree' has no options, got levels"),
])  # fmt: skip
def test_wrong_options_are_refused_before_anything_is_rendered(name, message):
    steps = []
    with pytest.raises(ValueError, match=message):
        compare.compare(rs.scenes.cornell(), ["rsh", name], size=(8, 8), progress=steps.append)
    assert steps == []
