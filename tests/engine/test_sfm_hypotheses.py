from dataclasses import replace

from swag_engine.sfm.hypotheses import Hypothesis, Outcome, choose_model, disagreement, is_usable

GOOD = Outcome(
    name="",
    groups=[[f"{number}.jpg" for number in range(40)]],
    points=5000,
    track_length=6.0,
    reprojection_error=0.6,
    triangulation_angle=8.0,
    focal_lengths={"1": 1000.0},
    fields_of_view={"1": 60.0},
)
WIDE = (("field_of_view", "129° is unlikely."),)
UNKNOWN = (("focal_error", "The focal length is known to 18 % only."),)
HELD = (("focal_held", "The focal length cannot be known."),)


def images(count: int) -> list[list[str]]:
    return [[f"{number}.jpg" for number in range(count)]]


def choose(*outcomes: Outcome) -> tuple[Outcome, list[Outcome]]:
    waiting = iter(outcomes)

    def run(hypothesis: Hypothesis) -> Outcome:
        return replace(next(waiting), name=hypothesis.name)

    return choose_model(run)


def test_a_model_without_doubts_is_the_only_one() -> None:
    best, tried = choose(GOOD)
    assert len(tried) == 1 and best is tried[0]


def test_photos_with_few_points_are_no_reason_to_try_again() -> None:
    assert len(choose(replace(GOOD, doubts=(("few_points", "7.jpg has few points."),)))[1]) == 1


def test_an_implausible_model_loses_to_a_plausible_one() -> None:
    wide = replace(GOOD, groups=images(33), focal_lengths={"1": 330.0}, fields_of_view={"1": 129.0}, doubts=WIDE)
    best, tried = choose(wide, GOOD)
    assert best is tried[1] and best.registered == 40
    assert disagreement(best, tried) is None


def test_two_models_that_agree_end_the_search() -> None:
    partial = replace(GOOD, groups=[*images(25), ["30.jpg", "31.jpg"]], doubts=(("registered", "Only 25."),))
    assert len(choose(partial, replace(partial, focal_lengths={"1": 1020.0}))[1]) == 2


def test_a_held_focal_length_is_better_than_one_that_is_not_known() -> None:
    free = replace(GOOD, points=9000, focal_lengths={"1": 700.0}, doubts=UNKNOWN)
    best, tried = choose(free, replace(GOOD, doubts=HELD))
    assert len(tried) == 2 and best is tried[1]


def test_a_failed_hypothesis_leaves_the_next_one() -> None:
    best, tried = choose(Outcome("", []), GOOD)
    assert best is tried[1]


def test_no_model_at_all() -> None:
    best, tried = choose(*[Outcome("", [])] * 4)
    assert len(tried) == 4 and not is_usable(best, 40)


def test_equally_good_models_of_different_focal_lengths_are_named() -> None:
    angle = (("triangulation_angle", "1.5° only."),)
    other = replace(GOOD, focal_lengths={"1": 1400.0}, fields_of_view={"1": 45.0}, doubts=angle)
    sentence = disagreement(GOOD, [GOOD, other])
    assert sentence and "from 45° to 60°" in sentence


def test_a_model_of_few_of_the_photos_is_not_worth_using() -> None:
    assert is_usable(replace(GOOD, groups=images(2)), 2)
    assert not is_usable(replace(GOOD, groups=images(2)), 10)
    assert is_usable(replace(GOOD, groups=images(6)), 50)
    assert not is_usable(replace(GOOD, groups=images(6)), 100)
