"""What every effect must keep to."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.errors import InputError
from gz_onboard.physics.effect import QUANTITIES, Port, known_effects, load_effect
from gz_onboard.physics.parameters import declared_parameters

EFFECTS = [load_effect(name) for name in known_effects()]
CONSERVATIVE = {"inertia", "grade_force"}  # what they take they give back
LIMITS = {
    "speed": (-5, 40), "acceleration": (-8, 8), "grade": (-0.3, 0.3), "grade_cosine": (0.9, 1), "mass": (50, 400),
    "air_density": (0.9, 1.5), "headwind": (-15, 15), "lateral_acceleration": (-8, 8), "motor_speed": (-30, 400),
    "motor_current": (-300, 300),
    "motor_temperature": (-40, 200),
}  # fmt: skip
PRIORS = {name: parameter.prior for name, parameter in declared_parameters().items()}


def quantities(**values):
    return {name: values.get(name, st.floats(*LIMITS[name], allow_subnormal=False)) for name in QUANTITIES}


def call(effect, values, **replaced):
    keywords = {name: PRIORS[name] for name in effect.keywords} | replaced
    return effect.term(*[values[name] for name in effect.quantities], **keywords)


def test_the_limits_cover_every_quantity():
    assert set(LIMITS) == set(QUANTITIES)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.name)
class TestContract:
    def test_says_what_it_is_and_where_it_is_from(self, effect):
        assert len(effect.doc) > 30
        assert isinstance(effect.port, Port)
        for parameter in effect.parameters:
            assert parameter.unit
            assert len(parameter.source) > 5
            assert parameter.low <= parameter.prior <= parameter.high
            assert parameter.prior_sd > 0

    @given(values=st.fixed_dictionaries(quantities()))
    def test_finite(self, effect, values):
        assert math.isfinite(call(effect, values))

    @given(rows=st.lists(st.fixed_dictionaries(quantities()), min_size=1, max_size=5))
    def test_array_equals_scalar(self, effect, rows):
        arrays = {name: np.array([row[name] for row in rows]) for name in QUANTITIES}
        together = np.broadcast_to(call(effect, arrays), len(rows))
        assert together == pytest.approx([call(effect, row) for row in rows], rel=1e-12, abs=1e-12)

    @given(values=st.fixed_dictionaries(quantities()))
    def test_zero_parameters_zero_term(self, effect, values):
        own = {parameter.name: 0.0 for parameter in effect.parameters}
        if own:
            assert call(effect, values, **own) == 0

    @given(values=st.fixed_dictionaries(quantities(headwind=st.just(0.0))))
    def test_dissipative_effects_never_give_energy(self, effect, values):
        if effect.name in CONSERVATIVE:
            return
        term = call(effect, values)
        power = term * values["speed"] if effect.port in (Port.WHEEL_FORCE, Port.TYRE) else term
        assert power >= -1e-12


def test_a_user_effect_is_one_file(tmp_path: Path):
    (tmp_path / "cornering_test.py").write_text(
        '"""A force that grows with speed, for a test of loading."""\n'
        "from gz_onboard.physics.effect import Parameter, Port\n"
        "PORT = Port.WHEEL_FORCE\n"
        'PARAMETERS = (Parameter("test_force", "N·s/m", 1.0, 1.0, 0.0, 9.0, "made up for a test"),)\n'
        "def term(speed, *, test_force):\n"
        "    return test_force * speed\n"
    )
    effect = load_effect("cornering_test", tmp_path)
    assert effect.term(3.0, test_force=2.0) == 6.0
    assert effect.quantities == ("speed",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PORT = 1\nPARAMETERS = ()\n", "needs term"),
        ("PORT = 1\nPARAMETERS = ()\ndef term(sped): return 0\n", "did you mean 'speed'"),
        ("PORT = 1\nPARAMETERS = ()\ndef term(speed, *, unknown_thing): return 0\n", "unknown_thing"),
        ("import nothing_of_this_name\n", "nothing_of_this_name"),
    ],
)
def test_a_bad_effect_file_is_refused_with_its_name(tmp_path, text, message):
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        load_effect("bad", tmp_path)
    assert "bad.py" in str(error.value)


def test_an_unknown_effect_names_the_nearest():
    with pytest.raises(InputError, match="did you mean 'aerodynamic_drag'"):
        load_effect("aerodynamic_dragg")
