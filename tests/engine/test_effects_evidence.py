"""Decisions about effects from observations whose truth is known, from the demo scene, and from real scenes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swag_engine.effects import depth_prior, interpolation, semantics
from swag_engine.effects.caustics import decide_by_flicker
from swag_engine.effects.registry import REGISTRY
from swag_engine.evidence.decision import Decision
from swag_engine.evidence.fit import GAINS, LENS, Family, WeightedObservations
from swag_engine.evidence.image_cells import open_water_light
from swag_engine.evidence.observations import FIT_WIDTH, Observations, observe
from swag_engine.evidence.scene_evidence import SceneEvidence
from swag_engine.evidence.water_terms import find_water_terms
from swag_engine.planning.plan import decide_all
from swag_engine.priors.depth import sparse_points
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.scene.split import split_views

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"
REAL = Path(__file__).resolve().parents[3] / "shared" / "data"
VIEWS = 20
BLUE = {"beta_D": (0.17, 0.06, 0.04), "beta_B": (0.14, 0.08, 0.06), "B": (0.03, 0.17, 0.25)}


def observations_of(
    beta_D=(0, 0, 0),
    beta_B=(0, 0, 0),
    B=(0, 0, 0),
    tau=None,
    gain_sd=0.0,
    sun=0.0,
    lens=0.0,
    spread=3.0,
    noise=0.06,
    grey=False,
    shade=(0.02, 0.3),
    count=600,
    seed=0,
):
    """`count` points, each seen in five of VIEWS photographs at ranges between 2 and 2 `spread`, with errors as large
    as photographs have (mostly alike in all channels), and beside each a pixel of `shade` times its light.

    The log light that water adds varies by `sun` with the direction of the photograph, all light with `gain_sd`."""
    r = np.random.default_rng(seed)
    track = np.repeat(np.arange(count), 5)
    image = np.concatenate([r.choice(VIEWS, 5, replace=False) for _ in range(count)])
    ranges = 2 * spread ** r.uniform(0, 1, len(track))
    place = r.uniform(-0.7, 0.7, (len(track), 2))
    radius = np.linalg.norm(place, axis=1)
    J = r.uniform(0.05, 0.7, (count, 3))
    if grey:
        J = np.repeat(J[:, :1], 3, 1)
    gains = np.exp(r.normal(0, gain_sd, VIEWS))[image] * (1 - lens * radius**2)
    direct = np.exp(-np.array(beta_D) * ranges[:, None])
    if tau is not None:
        direct = direct * ((tau + 9) / (tau + ranges**2))[:, None]
    veiling = np.array(B) * (1 - np.exp(-np.array(beta_B) * ranges[:, None]))
    veiling *= np.exp(sun * np.cos(2 * np.pi * image / VIEWS))[:, None]
    error = (
        1 + noise * r.standard_normal((len(track), 1)) + 0.3 * noise * r.standard_normal((len(track), 3)) * (not grey)
    )
    light = gains[:, None] * (J[track] * direct * error + veiling)
    darkest = gains[:, None] * (r.uniform(shade[0], shade[1], (len(track), 1)) * J[track] * direct + veiling)
    return Observations(track, ranges, light, image, place, darkest)


WATER_EFFECTS = ("attenuation", "backscatter", "separate_backscatter", "lamp", "exposure")


class Found:
    """Water terms of observations, and the decisions that follow."""

    def __init__(self, observations, open_water=None):
        evidence = SceneEvidence(scene=None, images=())
        evidence.observations = observations
        enough = len(observations) >= 200
        evidence.water_terms = find_water_terms(observations, open_water) if enough else None
        if evidence.water_terms:
            terms = evidence.water_terms
            self.fit, self.images, self.intervals = terms.fit, terms.images, terms.intervals
        self.effects: dict[str, Decision] = {}
        for name in WATER_EFFECTS:
            self.effects[name] = REGISTRY[name].decide(evidence, self.effects)


def states(observations):
    return {name: decision.state for name, decision in Found(observations).effects.items()}


EXPECTED = {"attenuation": "off", "backscatter": "off", "lamp": "off", "exposure": "off"}


@pytest.mark.parametrize(
    "scene, on",
    [
        ({}, ()),
        ({"seed": 1, "noise": 0.15}, ()),
        ({"lens": 0.4}, ()),
        ({"gain_sd": 0.12}, ("exposure",)),
        (BLUE, ("attenuation", "backscatter")),
        ({**BLUE, "gain_sd": 0.12, "lens": 0.3}, ("attenuation", "backscatter", "exposure")),
        ({"beta_D": BLUE["beta_D"]}, ("attenuation",)),
        ({"tau": 1.0}, ("lamp",)),
        ({**BLUE, "tau": 1.0}, ("attenuation", "backscatter", "lamp")),
    ],
)
def test_effects_that_are_there_are_found_and_no_others(scene, on):
    found = states(observations_of(**scene))
    found.pop("separate_backscatter")
    assert found == EXPECTED | dict.fromkeys(on, "on")


def test_figures_come_with_thresholds_and_a_sentence():
    decisions = Found(observations_of(**BLUE)).effects
    for decision in decisions.values():
        for name in decision.evidence:
            pair = {f"{name}_least", f"{name}_most"} & set(decision.evidence)
            assert pair or name.endswith(("_least", "_most")) or name == "ratio", name
        assert decision.reason.endswith(".")
    assert "Red loses 4" in decisions["attenuation"].reason and "threshold 10%" in decisions["attenuation"].reason


def test_values_and_intervals_hold_the_truth():
    found = Found(observations_of(**BLUE, count=2000))
    np.testing.assert_allclose(found.fit.beta_D, BLUE["beta_D"], rtol=0.15)
    veiling, truth = (
        B * -np.expm1(-5 * np.array(b))
        for B, b in ((found.fit.B, found.fit.beta_B), (np.array(BLUE["B"]), BLUE["beta_B"]))
    )
    np.testing.assert_allclose(veiling, truth, rtol=0.15)
    low, high = found.intervals["beta_D"]
    assert (low < high).all() and (low[0] < 0.17 * 1.05) and (high[0] > 0.17 * 0.95)
    assert (high - low)[0] < 0.06


def test_exact_observations_give_the_water_exactly():
    fit = Found(observations_of(**BLUE, noise=1e-4)).fit
    for name, truth in BLUE.items():
        np.testing.assert_allclose(getattr(fit, name), truth, rtol=0.01)


def test_wrong_matches_do_not_bend_the_water():
    seen = observations_of(**BLUE, noise=0.02, count=1500)
    wrong = np.random.default_rng(1).choice(len(seen), len(seen) // 50, replace=False)
    seen.light[wrong] = np.random.default_rng(2).uniform(0, 0.8, (len(wrong), 3))
    np.testing.assert_allclose(Found(seen).fit.beta_D, BLUE["beta_D"], rtol=0.15)


def test_exposures_are_those_of_the_images():
    observations = observations_of(gain_sd=0.15)
    found = Found(observations)
    # Divided by the fitted gains, the observations have none left.
    index = {image: k for k, image in enumerate(found.images)}
    gains = np.exp(found.fit.log_gains[[index[k] for k in observations.image]])
    again = Found(replace(observations, light=observations.light / gains[:, None]))
    assert found.effects["exposure"].evidence["gain_sd"] == pytest.approx(0.15, abs=0.06)
    assert again.effects["exposure"].evidence["gain_sd"] < 0.01


@pytest.mark.parametrize(
    "scene, words",
    [
        ({**BLUE, "spread": 1.06}, "ranges of ratio 1.0"),
        ({**BLUE, "count": 20}, "only 100 observations"),
    ],
)
def test_effects_that_cannot_be_determined_are_unknown(scene, words):
    for name, decision in Found(observations_of(**scene)).effects.items():
        if name in ("attenuation", "backscatter", "lamp"):
            assert decision.state == "unknown" and words in decision.reason


def test_vignetting_in_a_survey_leaves_water_undetermined():
    observations = observations_of(lens=0.4, noise=0.03)
    straight_down = replace(observations, ranges=4 / np.cos(0.65 * observations.radius))
    light = observations.light * np.exp(-0.17 * straight_down.ranges[:, None])
    found = Found(replace(straight_down, light=light)).effects
    assert found["attenuation"].state == found["lamp"].state == "unknown"
    assert "vary together" in found["attenuation"].reason


def test_exposure_is_determined_in_a_straight_survey_with_vignetting():
    """There, exposures that rise from image to image resemble a lens that is brighter on one side."""
    r = np.random.default_rng(0)
    X, Y, J = r.uniform(-1, 9, 1600), r.uniform(-0.6, 0.6, 1600), r.uniform(0.05, 0.7, (1600, 3))
    parts = []
    for k, gain in enumerate(np.exp(r.normal(0, 0.1, VIEWS))):
        seen = np.abs(X - 0.4 * k) < 0.8
        place = np.column_stack([X - 0.4 * k, Y])[seen]
        light = gain * J[seen] * (1 - 0.4 * (place**2).sum(1, keepdims=True))
        light = light * (1 + 0.06 * r.standard_normal((len(light), 1)))
        ranges = 4 * np.exp(0.1 * r.uniform(-1, 1, len(light)))
        parts.append((np.flatnonzero(seen), ranges, light, np.full(len(light), k), place, light / 3))
    found = Found(Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True))))
    exposure = found.effects["exposure"]
    assert exposure.state == "on" and exposure.evidence["gain_sd"] == pytest.approx(0.1, abs=0.03)


def test_veiling_light_that_the_darkest_pixels_lack_is_no_backscatter():
    observations = observations_of(**BLUE)
    assert states(observations)["backscatter"] == "on"
    assert states(replace(observations, darkest=0 * observations.darkest))["backscatter"] == "off"


def test_backscatter_is_found_where_a_lamp_lights_all_near_surfaces():
    """Without anything dark near the lamp, the darkest light falls with range although backscatter rises."""
    lit = {"tau": 1.0, "shade": (0.5, 1.0)}
    observations = observations_of(**BLUE, **lit)
    dark, ranges = observations.darkest.mean(1), observations.ranges
    assert np.quantile(dark[ranges < 2.5], 0.01) > 1.5 * np.quantile(dark[ranges > 5], 0.01)
    found = Found(observations).effects
    assert {found[name].state for name in ("attenuation", "backscatter", "lamp")} == {"on"}
    assert "beyond what the lamp explains" in found["backscatter"].reason
    clear = states(observations_of(**lit))
    assert clear["lamp"] == "on" and clear["attenuation"] != "on" and clear["backscatter"] == "off"


def test_light_lost_on_one_surface_only_is_not_water():
    """A highlight makes one surface redder the nearer it is; water acts on all surfaces alike."""
    observations = observations_of(count=800)
    _, first, track = np.unique(observations.track, return_index=True, return_inverse=True)
    shining = (observations.place[first, 0] > 0)[track]
    red = np.where(shining, np.exp(-0.1 * (observations.ranges - 2)), 1.0)
    light = observations.light * np.column_stack([red, np.ones((len(red), 2))])
    decision = Found(replace(observations, light=light)).effects["attenuation"]
    assert decision.evidence["change"][0] > decision.evidence["change_least"]
    assert decision.state == "unknown" and "shine" in decision.reason


def test_grey_attenuation_without_veiling_light_is_a_lamp():
    """Light that all channels lose alike is ascribed to the lamp; the fraction that water takes is undetermined."""
    found = Found(observations_of(grey=True, tau=0.5, beta_D=(0.2, 0.2, 0.2)))
    assert found.effects["lamp"].state == "on" and "no color" in found.effects["lamp"].reason
    assert found.effects["attenuation"].state != "on" and found.fit.tau < np.inf


def test_grey_attenuation_is_determined_by_the_veiling_light():
    turbid = {"beta_D": (0.16, 0.16, 0.16), "beta_B": (0.12, 0.12, 0.12)}
    veiled = observations_of(**turbid, B=(0.2, 0.2, 0.2), count=1500)
    found = states(veiled)
    assert found["attenuation"] == found["backscatter"] == "on"
    assert states(replace(veiled, darkest=np.zeros_like(veiled.darkest)))["attenuation"] != "on"


def test_a_weak_fall_off_needs_more_evidence_for_a_lamp():
    """In a room, distant surfaces can be darker, too; the light of a lamp falls off with the square of range."""
    near, partly = (Found(observations_of(tau=tau, noise=0.6, count=300)).effects["lamp"] for tau in (1.0, 60.0))
    assert near.state == "on"
    assert partly.state == "unknown" and 30 < partly.evidence["bic_gain"] < partly.evidence["bic_gain_least"]
    assert "With a lamp the attenuation would be" in partly.reason


def test_under_a_lamp_the_sum_of_both_losses_is_known_and_attenuation_has_a_wider_interval():
    """Lamp and water can replace each other, in all colors alike: more where the ranges differ less."""
    found, wide = (Found(observations_of(**BLUE, tau=1.0, spread=spread)) for spread in (3.0, 5.0))
    decision = found.effects["attenuation"]
    near, far = 2 * 3.0**0.05, 2 * 3.0**0.95  # 5th and 95th percentile of the ranges
    left = np.exp(-np.array(BLUE["beta_D"]) * (far - near)) * (1 + near**2) / (1 + far**2)
    np.testing.assert_allclose(decision.evidence["loss_with_lamp"], 1 - left, atol=0.03)
    assert "Lamp and water together take red 9" in decision.reason
    error = decision.evidence["error_under_lamp"]
    assert 0 < wide.effects["attenuation"].evidence["error_under_lamp"] < error
    low, high = found.intervals["beta_D"]
    assert np.all(high - low > error) and np.all((low < BLUE["beta_D"]) & (BLUE["beta_D"] < high))
    assert "loss_with_lamp" not in Found(observations_of(**BLUE)).effects["attenuation"].evidence


def test_backscatter_that_is_brighter_towards_the_sun_is_no_exposure():
    murky = {"beta_D": (0.35, 0.21, 0.2), "beta_B": (0.35, 0.21, 0.2), "B": (0.1, 0.37, 0.55)}
    sunlit = Found(observations_of(**murky, sun=0.2))
    exposure = sunlit.effects["exposure"]
    assert exposure.state == "off" and exposure.evidence["gain_sd"] > 0.06 and exposure.evidence["bic_gain"] < 0
    assert "backscatter that varies" in exposure.reason
    assert sunlit.fit.beta_D == pytest.approx(murky["beta_D"], rel=0.15)
    exposed = Found(observations_of(**murky, gain_sd=0.08)).effects["exposure"]
    assert exposed.state == "on" and exposed.evidence["bic_gain"] > 500


def test_light_that_is_added_alike_at_all_ranges_is_no_backscatter_beside_an_exposure():
    """As glare in a lens, where all ranges are alike."""
    glare = {"beta_B": (5, 5, 5), "B": (0.2, 0.2, 0.2), "sun": 0.3, "spread": 1.05}
    exposure = Found(observations_of(**glare, gain_sd=0.05)).effects["exposure"]
    assert exposure.state == "on" and "backscatter" not in exposure.reason


def test_exposure_under_a_lamp_needs_more_evidence():
    observations = observations_of(tau=1.0, gain_sd=0.06, noise=0.12, count=300)
    decision = Found(observations).effects["exposure"]
    assert 100 < decision.evidence["bic_gain"] < 700
    assert decision.state == "unknown" and "lamp" in decision.reason


def test_attenuation_below_the_resolution_is_undetermined():
    assert states(observations_of())["attenuation"] == "off"
    decision = Found(observations_of(count=60, noise=0.5, spread=1.5)).effects["attenuation"]
    assert decision.state == "unknown" and "would be known to" in decision.reason
    assert decision.evidence["resolution"] > decision.evidence["resolution_most"]


@pytest.mark.parametrize("separate", [True, False])
@pytest.mark.parametrize("B", [(0.05, 0.1, 0.2), (0.6, 0.6, 0.6)])
@pytest.mark.parametrize("varying", ["gains", "backscatter_gains"])
def test_derivatives_by_finite_differences(separate, B, varying):
    """Also where the veiling light is brighter than the image: the color of a point is then 0, not negative."""
    ready = WeightedObservations(observations_of(**BLUE, tau=2.0, gain_sd=0.1, lens=0.2, count=60))
    family = Family(True, True, separate, lamp=True, lens=True, **{varying: True})
    values = ready._start(family)
    values[6:9], values[LENS], values[GAINS:] = B, 0.1, 0.05 * np.arange(VIEWS)
    colors = np.stack([ready._solved(family, values, c)[3] for c in range(3)])
    assert (colors >= 0).all() and (B[0] < 0.5 or 0.2 < (colors == 0).mean() < 0.9)
    _, gradient, _ = ready._linearised(family, values)
    for index in (0, 1, 4, 6, 9, 10, 13, 15, 25):
        step = np.zeros_like(values)
        step[index] = 1e-5
        ends = []
        for sign in (1, -1):
            moved = values + sign * step
            if not separate:
                moved[3:6] = moved[:3]  # one coefficient for both
            ends.append(ready._linearised(family, moved)[0])
        assert gradient[index] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-6)


# -- caustics ----------------------------------------------------------------------------------------------------------


def flickering(strength, together=True, seed=0, shine=False):
    """400 points on a floor seen from ten near places, lit by patterns that neighbours share or not; with `shine` the
    pattern moves with the camera."""
    r = np.random.default_rng(seed)
    positions = np.column_stack([r.uniform(-2, 2, (400, 2)), np.zeros(400)])
    centres = np.column_stack([np.linspace(-0.3, 0.3, 10), np.zeros(10), np.full(10, 4.0)])
    parts = []
    for k, centre in enumerate(centres):
        ranges = np.linalg.norm(positions - centre, axis=1)
        moved = 4 * centre[0] if shine else 40 * k
        waves = np.sin(positions @ [6, 4, 0] + moved) if together else r.standard_normal(400)
        light = np.exp(strength * waves)[:, None] * np.full((400, 3), 0.3) * np.exp(0.02 * r.standard_normal((400, 3)))
        place = (positions[:, :2] - centre[:2]) / 4
        parts.append((np.arange(400), ranges, light, np.full(400, k), place, light))
    return Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), centres, positions


@pytest.mark.parametrize("strength, together, state", [(0.0, True, "off"), (0.3, True, "on"), (0.3, False, "off")])
def test_caustics_are_flicker_of_whole_patches(strength, together, state):
    decision = decide_by_flicker(*flickering(strength, together))
    assert decision.state == state
    if state == "on":
        assert decision.evidence["flicker"] == pytest.approx(0.3, rel=0.5)


def test_specular_highlights_are_no_caustics():
    """They change for whole patches, too, but less the nearer the views are."""
    decision = decide_by_flicker(*flickering(0.3, shine=True))
    assert decision.state == "off" and decision.evidence["flicker"] > decision.evidence["flicker_least"]
    assert decision.evidence["steadiness"] < decision.evidence["steadiness_least"]


def test_light_that_is_uneven_over_an_image_is_no_caustics():
    observations, centres, positions = flickering(0.0)
    beam = 0.3 * (-1.0) ** observations.image * observations.place[:, 0]
    lit = replace(observations, light=observations.light * np.exp(beam)[:, None])
    assert decide_by_flicker(lit, centres, positions).state == "off"


def test_local_tone_mapping_is_no_caustics():
    """It changes with each image, too, but over quarters of it."""
    observations, centres, positions = flickering(0.0)
    phase = 2.0 * observations.image[:, None] + observations.place * 8
    evened = replace(observations, light=observations.light * np.exp(0.2 * np.sin(phase).sum(1))[:, None])
    assert decide_by_flicker(evened, centres, positions).state == "off"


@pytest.mark.filterwarnings("error")
def test_a_constant_color_does_not_flicker():
    observations, centres, positions = flickering(0.0)
    decision = decide_by_flicker(replace(observations, light=np.full_like(observations.light, 0.3)), centres, positions)
    assert decision.state == "off" and decision.evidence["flicker"] == 0


def test_caustics_are_undetermined_without_near_views():
    observations, centres, positions = flickering(0.3)
    assert decide_by_flicker(observations.take(observations.image == 0), centres, positions).state == "unknown"


# -- whole images ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reef():
    scene = load_scene(REEF)
    return scene, load_images(scene, scene.views, 640)


def test_the_demo_scene_has_water_and_nothing_else(reef):
    scene, images = reef
    observations = observe(images, [view.point_indices for view in scene.views], scene.points)
    found = states(observations)
    found.pop("separate_backscatter")
    assert found == EXPECTED | {"attenuation": "on", "backscatter": "on"}
    centres = np.stack([image.camera.centre for image in images])
    assert decide_by_flicker(observations, centres, scene.points.positions).state == "off"


def test_the_demo_scene_gives_its_true_water(reef):
    scene, images = reef
    observations = observe(images, [view.point_indices for view in scene.views], scene.points)
    found = Found(observations, open_water_light(images, scene))
    truth = json.loads((REEF / "truth.json").read_text())["water"]
    np.testing.assert_allclose(found.fit.beta_D, truth["beta_D"], rtol=0.2)
    np.testing.assert_allclose(found.fit.B, truth["B_inf"], rtol=0.1)
    median = 5.5  # range; beta_B of red, whose veiling light is weak, is not determined
    veiling, expected = (
        B * -np.expm1(-np.array(beta_B) * median)
        for B, beta_B in ((found.fit.B, found.fit.beta_B), (truth["B_inf"], truth["beta_B"]))
    )
    np.testing.assert_allclose(veiling, expected, atol=0.01)


def decided(effect, scene, images, backscatter="off", **given):
    """The decision of one effect that asks for whole images."""
    earlier = {"backscatter": Decision(backscatter, {}, "")}
    return effect.decide(SceneEvidence(scene, images, **given), earlier)


def test_open_water_calls_for_labels(reef):
    scene, images = reef
    decision = decided(semantics, scene, images, "on")
    assert decision.state == "on" and 0.05 < decision.evidence["open_water"] < 0.4
    assert decided(semantics, scene, images).state == "off"
    assert decided(semantics, scene, images, labels_wanted=True).state == "on"


def test_depth_is_predicted_only_where_points_are_few(reef):
    scene, images = reef
    assert decided(depth_prior, scene, images, depth=lambda image: pytest.fail("the network was asked")).state == "off"
    few = replace(scene, views=tuple(replace(view, point_indices=view.point_indices[::4]) for view in scene.views))
    seen = {view.name: view.point_indices for view in few.views}
    ten = images[:10]
    assert decided(depth_prior, few, ten).state == "unknown"
    for wrong, state in ((1, "on"), (5, "off")):

        def depth(image, failing=ten[:wrong]):
            """Inverse range around the sparse points; the same everywhere in the images that fail."""
            prediction = np.zeros(image.valid.shape)
            if not any(image is other for other in failing):
                uv, inverse_range = sparse_points(image.camera, scene.points.positions[seen[image.camera.name]])
                for (column, row), value in zip(uv.astype(int).clip(2), inverse_range, strict=True):
                    prediction[row - 2 : row + 3, column - 2 : column + 3] = value
            return prediction

        decision = decided(depth_prior, few, ten, depth=depth)
        assert decision.state == state and decision.evidence["accepted"] == 1 - wrong / 10


def test_frames_are_interpolated_for_few_images_far_apart(reef):
    scene, _ = reef
    images = load_images(scene, scene.views, 160)  # small, so that the optical flow between them is found
    apart = [replace(v, point_indices=v.point_indices[v.point_indices % 2 == k % 2]) for k, v in enumerate(scene.views)]
    far = replace(scene, views=tuple(apart))  # neighbours share no points

    def true_frame(a, b, t):
        first, second = (next(k for k, image in enumerate(images) if image.pixels is frame) for frame in (a, b))
        return images[(first + second) // 2].pixels

    near = decided(interpolation, scene, images, interpolator=true_frame)
    assert near.state == "off" and near.evidence["shared_points"] > near.evidence["shared_points_most"]
    assert decided(interpolation, far, images).state == "unknown"
    accepted = decided(interpolation, far, images, interpolator=true_frame)
    assert accepted.state == "on" and accepted.evidence["shared_points"] == 0
    black = decided(interpolation, far, images, interpolator=lambda a, b, t: np.zeros_like(a))
    assert black.state == "off" and "frames differ from the images" in black.reason
    assert decided(interpolation, replace(far, views=far.views[:1]), images).state == "off"


def test_every_effect_is_decided_in_words(reef):
    scene, images = reef
    decisions = decide_all(SceneEvidence(scene, images))
    assert list(decisions) == list(REGISTRY)
    assert all(decision.reason.endswith(".") for decision in decisions.values())
    assert decisions["moving_objects"].state == "unknown"  # until training or masks show them


# -- real scenes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, expected",
    [
        ("japanese_gardens", {"attenuation": "on", "backscatter": "on"}),
        ("aqualoc_amphorae", {"attenuation": "unknown", "backscatter": "off", "lamp": "on", "exposure": "on"}),
        ("sparus_seabed", {"attenuation": "unknown", "backscatter": "unknown", "lamp": "unknown"}),
    ],
)
def test_real_scenes(name, expected):
    folder = REAL / name
    if not folder.exists():
        pytest.skip(f"{folder} is not on this machine")
    scene = load_scene(folder)
    test = set(split_views([view.name for view in scene.views]).test)
    views = [view for view in scene.views if view.name not in test]
    images = load_images(scene, views, FIT_WIDTH)
    observations = observe(images, [view.point_indices for view in views], scene.points)
    found = Found(observations, open_water_light(images, scene)).effects
    assert {effect: found[effect].state for effect in expected} == expected
    centres = np.stack([image.camera.centre for image in images])
    assert decide_by_flicker(observations, centres, scene.points.positions).state == "off"
