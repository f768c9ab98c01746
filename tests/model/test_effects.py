"""What every effect must keep to."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.errors import InputError
from gz_onboard.model.effect import QUANTITIES, Port, effects_in, load_effect, package_effects
from gz_onboard.model.model import Bound, stepping
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.model.series import over
from gz_onboard.model.traits import traits

EFFECTS = [load_effect(name) for name in package_effects()]
CONSERVATIVE = {"inertia", "grade_force", "headwind"}  # what they take they give back; the wind gives of its own
LIMITS = {
    "speed": (-5, 40),
    "acceleration": (-8, 8),
    "grade": (-0.3, 0.3),
    "grade_cosine": (0.9, 1),
    "mass": (50, 400),
    "air_density": (0.9, 1.5),
    "headwind": (-15, 15),
    "lateral_acceleration": (-8, 8),
    "motor_speed": (-30, 400),
    "motor_current": (-300, 300),
    "vibration": (0, 10),
    "motor_temperature": (-40, 200),
    "torque": (-120, 120),
    "heading": (-10, 10),
    "time_moving": (0, 1e4),
    "ambient_temperature": (-30, 50),
    "cell_current": (-30, 30),
    "cell_temperature": (-30, 70),
    "cell_capacity": (0.5, 50),
    "soc": (-0.05, 1.05),
}
PRIORS = {name: parameter.prior for name, parameter in declared_parameters().items()}


def quantities(**values):
    return {name: values.get(name, st.floats(*LIMITS[name], allow_subnormal=False)) for name in QUANTITIES}


MEMORY = [effect for effect in EFFECTS if effect.decay]
ALL = {name: st.floats(*LIMITS[name], allow_subnormal=False) for name in QUANTITIES}


def call(effect, values, **replaced):
    keywords = {name: PRIORS[name] for name in effect.term.parameters} | replaced
    return effect.term.function(*[values[name] for name in effect.term.quantities], **keywords)


def test_the_limits_cover_every_quantity():
    assert set(LIMITS) == set(QUANTITIES)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.name)
class TestContract:
    def test_says_what_it_is_and_where_it_is_from(self, effect):
        assert len(traits(effect).doc) > 30
        assert isinstance(effect.port, Port)
        for parameter in effect.parameters:
            assert parameter.unit
            assert len(parameter.source) > 5
            assert declared_parameters()[parameter.name] == parameter, "another effect has one of that name"
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
        sizes = [p for p in effect.parameters if p.unit != "s" and not (p.unit == "1" and p.low > 0)]
        own = {p.name: 0.0 for p in sizes if p.name in effect.term.parameters}
        if own:
            assert call(effect, values, **own) == 0

    @given(values=st.fixed_dictionaries(quantities(headwind=st.just(0.0))))
    def test_dissipative_effects_never_give_energy(self, effect, values):
        if effect.name in CONSERVATIVE or effect.port is Port.CELL_VOLTAGE:
            return  # for those in the cells see below
        term = call(effect, values)
        power = term * values["speed"] if effect.port in (Port.WHEEL_FORCE, Port.TYRE) else term
        assert power >= -1e-12


def bound(effect):
    return Bound(effect, PRIORS)


@pytest.mark.parametrize("effect", MEMORY, ids=lambda e: e.name)
class TestMemory:
    """What effects with memory must keep to beside."""

    @given(values=st.fixed_dictionaries(ALL), dt=st.floats(0, 1e5))
    def test_decay_is_a_share_that_two_half_steps_make_too(self, effect, values, dt):
        e = bound(effect)
        assert e.decay(0.0, values) == 1
        assert 0 <= e.decay(dt, values) <= 1
        assert e.decay(dt / 2, values) ** 2 == pytest.approx(e.decay(dt, values), rel=1e-9, abs=1e-12)

    @given(values=st.fixed_dictionaries(ALL), state=st.floats(-0.5, 0.5), dt=st.floats(0.01, 1e4))
    def test_two_half_steps_make_one_step(self, effect, values, state, dt):
        e = bound(effect)
        halves = e.step(e.step(state, dt / 2, values), dt / 2, values)
        assert halves == pytest.approx(e.step(state, dt, values), rel=1e-9, abs=1e-12)

    @given(values=st.fixed_dictionaries(ALL | {"cell_current": st.floats(0.5, 30)}), state=st.floats(-0.5, 0.5))
    def test_settles_at_its_term_and_stays_between(self, effect, values, state):
        e = bound(effect)
        assert e.step(state, 1e7, values) == pytest.approx(e(values), rel=1e-9, abs=1e-12)
        low, high = sorted((state, e(values)))
        assert low - 1e-12 <= e.step(state, 100.0, values) <= high + 1e-12

    @given(rows=st.lists(st.fixed_dictionaries(ALL), min_size=1, max_size=8), dt=st.floats(0.01, 1e3))
    def test_a_series_equals_steps(self, effect, rows, dt):
        e = bound(effect)
        arrays = {name: np.array([row[name] for row in rows]) for name in QUANTITIES}
        states: dict[str, float] = {}
        step = stepping(states, dt)
        one_by_one = [step(e, row) for row in rows]
        assert over(dt)(e, arrays) == pytest.approx(one_by_one, rel=1e-9, abs=1e-12)
        assert over(np.full(len(rows), dt))(e, arrays) == pytest.approx(one_by_one, rel=1e-9, abs=1e-12)
        assert states == {effect.name: one_by_one[-1]}

    @given(currents=st.lists(st.floats(-20, 20), min_size=1, max_size=30))
    def test_cells_never_give_energy_of_it(self, effect, currents):
        """From rest, whatever the current: what it takes less what it stores (both are passive)."""
        if effect.port is not Port.CELL_VOLTAGE:
            return
        e, x, taken, turned = bound(effect), 0.0, 0.0, 0.0
        values = {name: PRIORS.get(name, 0.0) for name in QUANTITIES} | {"cell_capacity": 2.8}
        for current in currents:
            for _ in range(20):
                values["cell_current"] = current
                before, x = x, e.step(x, 1.0, values)
                taken += (before + x) / 2 * current
                turned += abs(x * current)
        assert taken >= -0.01 * turned - 1e-12


def test_headwind_is_the_difference_of_the_drag_and_goes_round_with_the_heading():
    wind, drag = (load_effect(name).term.function for name in ("headwind", "aerodynamic_drag"))
    blow = {"drag_area": 0.5, "wind_north": 3.0, "wind_east": 0.0}

    def force(heading):
        return wind(10.0, 0.0, heading, 1.2, **blow)

    def still(headwind):
        return drag(10.0, headwind, 1.2, drag_area=0.5)

    assert force(0.0) == pytest.approx(still(3.0) - still(0.0))  # to the north, from where it blows
    assert force(math.pi) == pytest.approx(still(-3.0) - still(0.0))
    assert force(math.pi / 2) == pytest.approx(0.0, abs=1e-9)
    assert wind(10.0, 0.0, math.pi / 2, 1.2, **blow | {"wind_north": 0.0, "wind_east": 3.0}) == pytest.approx(
        force(0.0)
    )


def test_candidates_say_what_shows_them():
    for name in (
        "cornering_drag",
        "headwind",
        "dragging_brake",
        "tyre_warm_up",
        "drivetrain_drag",
        "regen_loss",
        "slow_relaxation",
        "ocv_hysteresis",
    ):
        assert len(traits(load_effect(name)).shown_by) > 40


def test_a_folder_of_effects(tmp_path):
    for name in ("one", "_helper"):
        (tmp_path / f"{name}.py").write_text("")
    assert effects_in(tmp_path) == ("one",)
    with pytest.raises(InputError, match="no such folder"):
        effects_in(tmp_path / "none")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PORT = 1\nPARAMETERS = ()\n", "needs term"),
        ("PORT = 1\nPARAMETERS = ()\ndef term(sped): return 0\n", "did you mean 'speed'"),
        ("PORT = 1\nPARAMETERS = ()\ndef term(speed, *, unknown_thing): return 0\n", "unknown_thing"),
        (
            "from gz_onboard.model.effect import Port\nPORT = Port.TYRE\nPARAMETERS = ()\n"
            "def term(speed): return 0\ndef decay(speed): return 1\n",
            "must be dt",
        ),
        ("PORT = 1\nPARAMETERS = ()\ndef term(speed): return 0\n", "Port.WHEEL_FORCE"),
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
