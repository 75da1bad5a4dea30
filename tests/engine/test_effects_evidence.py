"""Which effects are found in sightings whose truth is known, and in the demo scene."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swag_engine.effects import depth_prior, interpolation, semantics
from swag_engine.effects.caustics import decide_by_flicker
from swag_engine.effects.registry import REGISTRY
from swag_engine.evidence.decision import Decision
from swag_engine.evidence.fit import GAINS, LENS, Family, Sightings
from swag_engine.evidence.image_cells import open_water_light
from swag_engine.evidence.observations import FIT_WIDTH, Observations, observe
from swag_engine.evidence.scene_evidence import SceneEvidence
from swag_engine.evidence.water_terms import find_water_terms
from swag_engine.planning.plan import decide_all
from swag_engine.priors.depth import Alignment
from swag_engine.priors.interpolate import InterpolationTest
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import load_images
from swag_engine.scene.split import split_views

REEF = Path(__file__).parents[1] / "scenes" / "reef_wreck"
REAL = Path(__file__).resolve().parents[3] / "shared" / "data"
VIEWS = 20
BLUE = {"beta_D": (0.17, 0.06, 0.04), "beta_B": (0.14, 0.08, 0.06), "B": (0.03, 0.17, 0.25)}


def sightings(
    beta_D=(0, 0, 0),
    beta_B=(0, 0, 0),
    B=(0, 0, 0),
    tau=None,
    gain_sd=0.0,
    lens=0.0,
    spread=3.0,
    noise=0.06,
    grey=False,
    count=600,
    seed=0,
):
    """`count` points, each seen in five of VIEWS photographs at ranges between 2 and 2 `spread`, with errors as large
    as photographs have (mostly alike in all channels), and a dark pixel beside each."""
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
    veil = np.array(B) * (1 - np.exp(-np.array(beta_B) * ranges[:, None]))
    error = (
        1 + noise * r.standard_normal((len(track), 1)) + 0.3 * noise * r.standard_normal((len(track), 3)) * (not grey)
    )
    light = gains[:, None] * (J[track] * direct * error + veil)
    darkest = gains[:, None] * (r.uniform(0.02, 0.3, (len(track), 1)) * J[track] * direct + veil)
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
        self.effects = {}
        for name in WATER_EFFECTS:
            self.effects[name] = REGISTRY[name].decide(evidence, self.effects)


water_findings = Found


def states(observations):
    return {name: finding.state for name, finding in water_findings(observations).effects.items()}


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
def test_what_is_there_is_found_and_nothing_else(scene, on):
    found = states(sightings(**scene))
    found.pop("separate_backscatter")
    assert found == EXPECTED | dict.fromkeys(on, "on")


def test_figures_come_with_their_thresholds_and_words():
    findings = water_findings(sightings(**BLUE)).effects
    for finding in findings.values():
        for name in finding.evidence:
            pair = {f"{name}_least", f"{name}_most"} & set(finding.evidence)
            assert pair or name.endswith(("_least", "_most")) or name == "ratio", name
        assert finding.reason.endswith(".")
    assert "Red loses 4" in findings["attenuation"].reason and "threshold 10%" in findings["attenuation"].reason


def test_values_and_intervals_hold_the_truth():
    found = water_findings(sightings(**BLUE, count=2000))
    np.testing.assert_allclose(found.fit.beta_D, BLUE["beta_D"], rtol=0.15)
    veil, truth = (
        B * -np.expm1(-5 * np.array(b))
        for B, b in ((found.fit.B, found.fit.beta_B), (np.array(BLUE["B"]), BLUE["beta_B"]))
    )
    np.testing.assert_allclose(veil, truth, rtol=0.15)
    low, high = found.intervals["beta_D"]
    assert (low < high).all() and (low[0] < 0.17 * 1.05) and (high[0] > 0.17 * 0.95)
    assert (high - low)[0] < 0.06


def test_exact_sightings_give_the_water_exactly():
    fit = water_findings(sightings(**BLUE, noise=1e-4)).fit
    for name, truth in BLUE.items():
        np.testing.assert_allclose(getattr(fit, name), truth, rtol=0.01)


def test_wrong_matches_do_not_bend_the_water():
    seen = sightings(**BLUE, noise=0.02, count=1500)
    wrong = np.random.default_rng(1).choice(len(seen), len(seen) // 50, replace=False)
    seen.light[wrong] = np.random.default_rng(2).uniform(0, 0.8, (len(wrong), 3))
    np.testing.assert_allclose(water_findings(seen).fit.beta_D, BLUE["beta_D"], rtol=0.15)


def test_gains_are_those_of_the_photographs():
    observations = sightings(gain_sd=0.15)
    found = water_findings(observations)
    # What the gains explain is gone from the residuals of a second look.
    index = {image: k for k, image in enumerate(found.images)}
    gains = np.exp(found.fit.log_gains[[index[k] for k in observations.image]])
    again = water_findings(replace(observations, light=observations.light / gains[:, None]))
    assert found.effects["exposure"].evidence["gain_sd"] == pytest.approx(0.15, abs=0.06)
    assert again.effects["exposure"].evidence["gain_sd"] < 0.01


@pytest.mark.parametrize(
    "scene, words",
    [
        ({**BLUE, "spread": 1.06}, "ranges of ratio 1.0"),
        ({**BLUE, "count": 20}, "only 100 observations"),
    ],
)
def test_it_says_when_it_cannot_tell(scene, words):
    for name, finding in water_findings(sightings(**scene)).effects.items():
        if name in ("attenuation", "backscatter", "lamp"):
            assert finding.state == "unknown" and words in finding.reason


def test_fall_off_to_the_corners_in_a_survey_cannot_be_told_from_water():
    observations = sightings(lens=0.4, noise=0.03)
    straight_down = replace(observations, ranges=4 / np.cos(0.65 * observations.radius))
    light = observations.light * np.exp(-0.17 * straight_down.ranges[:, None])
    found = water_findings(replace(straight_down, light=light)).effects
    assert found["attenuation"].state == found["lamp"].state == "unknown"
    assert "vary together" in found["attenuation"].reason


def test_gains_are_told_in_a_straight_survey_through_a_lens_that_falls_off():
    """There gains that rise from photograph to photograph look like a lens that is brighter on one side."""
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
    finding = water_findings(Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True))))
    exposure = finding.effects["exposure"]
    assert exposure.state == "on" and exposure.evidence["gain_sd"] == pytest.approx(0.1, abs=0.03)


def test_a_veil_that_the_darkest_light_does_not_show_is_no_backscatter():
    observations = sightings(**BLUE)
    assert states(observations)["backscatter"] == "on"
    assert states(replace(observations, darkest=0 * observations.darkest))["backscatter"] == "off"


def test_what_one_surface_loses_is_not_water():
    """Shine makes one surface redder the nearer it is; water takes from all surfaces alike."""
    observations = sightings(count=800)
    _, first, track = np.unique(observations.track, return_index=True, return_inverse=True)
    shining = (observations.place[first, 0] > 0)[track]
    red = np.where(shining, np.exp(-0.1 * (observations.ranges - 2)), 1.0)
    light = observations.light * np.column_stack([red, np.ones((len(red), 2))])
    finding = water_findings(replace(observations, light=light)).effects["attenuation"]
    assert finding.evidence["change"][0] > finding.evidence["change_least"]
    assert finding.state == "unknown" and "shine" in finding.reason


def test_grey_loss_is_a_lamp():
    """Water has a colour: what all channels lose alike is the lamp's light, and water's share of it cannot be told."""
    found = water_findings(sightings(grey=True, tau=0.5, beta_D=(0.2, 0.2, 0.2)))
    assert found.effects["lamp"].state == "on" and "no color" in found.effects["lamp"].reason
    assert found.effects["attenuation"].state != "on" and found.fit.tau < np.inf


def test_water_that_takes_from_all_colours_alike_is_told_by_its_veil():
    turbid = {"beta_D": (0.16, 0.16, 0.16), "beta_B": (0.12, 0.12, 0.12)}
    veiled = sightings(**turbid, B=(0.2, 0.2, 0.2), count=1500)
    assert states(veiled)["attenuation"] == states(veiled)["backscatter"] == "on"
    assert states(replace(veiled, darkest=np.zeros_like(veiled.darkest)))["attenuation"] != "on"


def test_light_that_falls_off_less_than_a_lamps_has_to_be_surer():
    """In a room, what is far off can be darker, too; a lamp's light falls off with the square of range."""
    near, partly = (water_findings(sightings(tau=tau, noise=0.6, count=300)).effects["lamp"] for tau in (1.0, 60.0))
    assert near.state == "on"
    assert partly.state == "unknown" and 30 < partly.evidence["bic_gain"] < partly.evidence["bic_gain_least"]


def test_exposure_by_a_lamp_has_to_be_surer():
    observations = sightings(tau=1.0, gain_sd=0.06, noise=0.12, count=300)
    finding = water_findings(observations).effects["exposure"]
    assert 100 < finding.evidence["bic_gain"] < 700
    assert finding.state == "unknown" and "lamp" in finding.reason


def test_a_loss_that_could_not_be_seen_is_not_denied():
    assert states(sightings())["attenuation"] == "off"
    finding = water_findings(sightings(count=60, noise=0.5, spread=1.5)).effects["attenuation"]
    assert finding.state == "unknown" and "would be known to" in finding.reason
    assert finding.evidence["resolution"] > finding.evidence["resolution_most"]


@pytest.mark.parametrize("separate", [True, False])
@pytest.mark.parametrize("B", [(0.05, 0.1, 0.2), (0.6, 0.6, 0.6)])
def test_derivatives_by_finite_differences(separate, B):
    """Where the veil would be brighter than what is photographed, too: there a point is black, and not less."""
    ready = Sightings(sightings(**BLUE, tau=2.0, gain_sd=0.1, lens=0.2, count=60))
    family = Family(True, True, separate, lamp=True, lens=True, gains=True)
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
def test_caustics_are_light_that_flickers_on_whole_patches(strength, together, state):
    finding = decide_by_flicker(*flickering(strength, together))
    assert finding.state == state
    if state == "on":
        assert finding.evidence["flicker"] == pytest.approx(0.3, rel=0.5)


def test_shine_is_no_caustics():
    """It changes too, and for whole patches, but the less the nearer the views."""
    finding = decide_by_flicker(*flickering(0.3, shine=True))
    assert finding.state == "off" and finding.evidence["flicker"] > finding.evidence["flicker_least"]
    assert finding.evidence["steadiness"] < finding.evidence["steadiness_least"]


def test_light_that_is_uneven_over_a_photograph_is_no_caustics():
    observations, centres, positions = flickering(0.0)
    beam = 0.3 * (-1.0) ** observations.image * observations.place[:, 0]
    lit = replace(observations, light=observations.light * np.exp(beam)[:, None])
    assert decide_by_flicker(lit, centres, positions).state == "off"


def test_contrast_that_a_telephone_evens_out_is_no_caustics():
    """It changes with each photograph, too, but over quarters of it."""
    observations, centres, positions = flickering(0.0)
    phase = 2.0 * observations.image[:, None] + observations.place * 8
    evened = replace(observations, light=observations.light * np.exp(0.2 * np.sin(phase).sum(1))[:, None])
    assert decide_by_flicker(evened, centres, positions).state == "off"


@pytest.mark.filterwarnings("error")
def test_one_colour_does_not_flicker():
    observations, centres, positions = flickering(0.0)
    finding = decide_by_flicker(replace(observations, light=np.full_like(observations.light, 0.3)), centres, positions)
    assert finding.state == "off" and finding.evidence["flicker"] == 0


def test_caustics_cannot_be_told_without_near_views():
    observations, centres, positions = flickering(0.3)
    assert decide_by_flicker(observations.take(observations.image == 0), centres, positions).state == "unknown"


# -- whole photographs -------------------------------------------------------------------------------------------------


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
    found = water_findings(observations, open_water_light(images, scene))
    truth = json.loads((REEF / "truth.json").read_text())["water"]
    np.testing.assert_allclose(found.fit.beta_D, truth["beta_D"], rtol=0.2)
    np.testing.assert_allclose(found.fit.B, truth["B_inf"], rtol=0.1)
    median = 5.5  # range: how fast red's little veil comes nobody can see
    veil, expected = (
        B * -np.expm1(-np.array(beta_B) * median)
        for B, beta_B in ((found.fit.B, found.fit.beta_B), (truth["B_inf"], truth["beta_B"]))
    )
    np.testing.assert_allclose(veil, expected, atol=0.01)


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


def test_depth_is_only_asked_for_where_points_are_few(reef, monkeypatch):
    scene, images = reef
    assert decided(depth_prior, scene, images, depth=lambda image: pytest.fail("the network was asked")).state == "off"
    few = replace(scene, views=tuple(replace(view, point_indices=view.point_indices[::4]) for view in scene.views))
    assert decided(depth_prior, few, images).state == "unknown"
    for accepted, state in ((9, "on"), (5, "off")):
        judged = {k: Alignment(1.0, 0.0, 100, 0.9, k < accepted, "") for k in range(10)}
        monkeypatch.setattr(depth_prior, "depth_priors", lambda *arguments, judged=judged: ({}, judged))
        assert decided(depth_prior, few, images, depth=lambda image: None).state == state


def test_interpolated_frames_are_for_few_images_far_apart(reef, monkeypatch):
    scene, images = reef
    far = replace(scene, views=scene.views[::3])
    judged = InterpolationTest(3, 27.0, 2.0, 0.9, True, "")
    monkeypatch.setattr(interpolation, "interpolation_test", lambda *arguments: judged)
    near = decided(interpolation, scene, images)
    assert near.evidence["shared_points"] > decided(interpolation, far, images).evidence["shared_points"] > 0
    monkeypatch.setattr(interpolation, "MOST_SHARED", 0.9)
    assert decided(interpolation, far, images).state == "unknown"
    assert decided(interpolation, far, images, interpolator=lambda *frames: None).state == "on"
    judged = InterpolationTest(3, 20.0, 2.0, 0.9, False, "Interpolated frames miss the images.")
    assert decided(interpolation, far, images, interpolator=lambda *frames: None).reason == judged.reason
    monkeypatch.setattr(interpolation, "neighbour_pairs", lambda *names: [])
    assert decided(interpolation, far, images).state == "off"


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
    found = water_findings(observations, open_water_light(images, scene)).effects
    assert {effect: found[effect].state for effect in expected} == expected
    centres = np.stack([image.camera.centre for image in images])
    assert decide_by_flicker(observations, centres, scene.points.positions).state == "off"
