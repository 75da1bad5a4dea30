"""The process of a Blender version that runs the scripts of all tests: nothing goes from one script to the next."""

import pytest


def test_a_script_finds_nothing_of_the_one_before(blender):
    before = blender.run("isolation.found_state")
    left = blender.run("isolation.leave_everything")
    unchanged = [name for name in before if left[name] == before[name]]
    assert not unchanged, "the script left everything that is compared"
    assert blender.run("isolation.found_state") == before


@pytest.mark.main_version
@pytest.mark.parametrize(
    ("function", "message"),
    [("crash", "ended with exit code -6"), ("hang", "did not answer within 3 s"), ("fail", "ValueError: this script")],
)
def test_a_script_that_fails_gives_its_reason_and_the_next_one_runs(blender, function, message):
    before = blender.run("isolation.found_state")
    with pytest.raises(AssertionError, match=message) as failed:
        blender.run(f"isolation.{function}", seconds=3 if function == "hang" else 300)
    assert function != "crash" or "the last words" in str(failed.value)
    after = blender.run("isolation.found_state")
    assert [after.pop("process")[1] == before.pop("process")[1], after == before] == [function == "fail", True]
