import numpy as np

from swag_engine.sfm.pairs import choose_pairs


def survey(lanes: int, columns: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Make descriptors and positions of a lawn-mower survey; photos share half with the next one and the next lane."""
    random = np.random.default_rng(0)
    cells = {}
    descriptors, positions = [], []
    for lane in range(lanes):
        for column in range(columns) if lane % 2 == 0 else reversed(range(columns)):
            seen = []
            for cell in ((lane, column), (lane, column + 1), (lane + 1, column), (lane + 1, column + 1)):
                if cell not in cells:
                    cells[cell] = random.gamma(0.4, 60, (10, 128))
                seen.append(cells[cell])
            found = np.concatenate(seen)
            descriptors.append(np.clip(found + random.normal(0, 8, found.shape), 0, 255).astype(np.uint8))
            positions.append((lane, column))
    return descriptors, np.array(positions)


def test_neighbouring_lanes_of_a_survey_are_matched() -> None:
    lanes, columns = 10, 30
    descriptors, positions = survey(lanes, columns)
    pairs = choose_pairs(descriptors, [range(len(descriptors))])
    assert len(pairs) <= 12 * len(descriptors)
    number = {tuple(place): index for index, place in enumerate(positions)}
    across = [
        tuple(sorted((number[lane, column], number[lane + 1, column])))
        for lane in range(lanes - 1)
        for column in range(columns)
    ]
    assert np.mean([pair in set(pairs) for pair in across]) > 0.95


def test_the_number_of_pairs_grows_with_that_of_photos() -> None:
    counts = [len(choose_pairs(survey(4, columns)[0], [range(4 * columns)])) for columns in (30, 60)]
    assert counts[1] < 2.2 * counts[0]


def test_neighbours_are_matched_also_without_features() -> None:
    pairs = choose_pairs([np.zeros((0, 128), np.uint8)] * 5, [range(5), [0, 4, 1, 3, 2]])
    assert set(pairs) == {(0, 1), (0, 2), (0, 4), (1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)}


def test_photos_near_by_gps_are_compared_when_all_look_alike() -> None:
    random = np.random.default_rng(0)
    common = random.gamma(0.4, 60, (60, 128))  # every photo looks the same to the vocabulary
    own = random.gamma(0.4, 60, (4, 128))
    descriptors = [np.clip(common + random.normal(0, 8, common.shape), 0, 255) for _ in range(150)]
    for image in (3, 120):
        descriptors[image] = np.concatenate([descriptors[image], own])
    positions = np.full((150, 2), np.nan)
    positions[[3, 70, 120]] = [[0, 0], [500, 0], [1, 1]]
    assert (3, 120) in choose_pairs(descriptors, [range(150)], positions)
