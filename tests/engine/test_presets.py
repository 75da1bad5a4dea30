"""Water by name or by number."""

import math

import numpy as np
import pytest
import torch

from swag_engine.base.errors import InputError
from swag_engine.settings.jerlov import JERLOV, water_of_type
from swag_engine.water.medium import Medium


@pytest.mark.parametrize("name", JERLOV)
def test_a_name_gives_attenuation_per_scene_unit(name):
    beta_D, beta_B = water_of_type(name, 0.5)
    np.testing.assert_allclose(beta_D, np.array(JERLOV[name]) / 2)
    np.testing.assert_array_equal(beta_B, beta_D)
    medium = Medium.starting(40.0, beta_D=torch.from_numpy(beta_D), beta_B=torch.from_numpy(beta_B))
    np.testing.assert_allclose(medium.beta_D, beta_D, rtol=1e-5)


def test_clear_ocean_is_clearer_than_murky_coast():
    for clear, murky in zip(list(JERLOV)[:-1], list(JERLOV)[1:], strict=True):
        assert all(a <= b for a, b in zip(JERLOV[clear][1:], JERLOV[murky][1:], strict=True))
    red, green, blue = JERLOV["I"]
    assert red > green > blue


@pytest.mark.parametrize("text", ["0.3,0.1,0.06", " 0.3, 0.1 ,0.06 ", "3e-1,1e-1,6e-2"])
def test_three_numbers_are_per_metre(text):
    np.testing.assert_allclose(water_of_type(text, 2.0)[0], [0.6, 0.2, 0.12])


def test_names_in_any_case():
    np.testing.assert_array_equal(water_of_type(" 1c ", 1.0)[0], water_of_type("1C", 1.0)[0])


@pytest.mark.parametrize("text", ["IV", "", "clear", "0.3", "0.3,0.1", "0.3,0.1,0.06,1", "a,b,c", "0.3;0.1;0.06"])
def test_unknown_water_is_refused_with_what_there_is(text):
    with pytest.raises(InputError, match="is not known: use one of I, IA, .*0.3,0.1,0.06"):
        water_of_type(text, 1.0)


@pytest.mark.parametrize("text", ["-0.1,0.1,0.1", "0.1,nan,0.1", "0.1,0.1,inf", "11,0.1,0.1", "1e300,0,0"])
def test_absurd_water_is_refused(text):
    with pytest.raises(InputError, match="from 0 to 10 per metre"):
        water_of_type(text, 1.0)


@pytest.mark.parametrize("scale", [None, 0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("text", ["II", "0.3,0.1,0.06"])
def test_a_scene_without_scale_is_refused(text, scale):
    with pytest.raises(InputError, match="metres per unit"):
        water_of_type(text, scale)
