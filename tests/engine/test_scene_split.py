import pytest

from swag_engine.scene.split import split_views


def names(count: int) -> list[str]:
    return [f"{i:04d}.jpg" for i in range(count)]


@pytest.mark.parametrize("count", range(1, 60))
def test_views_are_split_without_overlap_and_leave_enough_to_train(count: int) -> None:
    split = split_views(reversed(names(count)))
    parts = split.train + split.validation + split.test
    assert sorted(parts) == names(count) and len(set(parts)) == count
    assert len(split.train) >= min(count, 2)
    if count >= 4:
        assert split.test == tuple(names(count)[::8])  # the field's protocol, which published figures use
        assert len(split.validation) >= 1


def test_validation_is_an_eighth_of_what_test_leaves() -> None:
    split = split_views(names(400))
    assert len(split.test) == 50 and len(split.validation) == 44
    assert split_views(names(40)) == split_views(names(40))
