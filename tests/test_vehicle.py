from __future__ import annotations

import importlib.util
import os
import py_compile
import re
from pathlib import Path

import pytest

import gz_onboard
from gz_onboard.errors import InputError
from gz_onboard.model.effect import load_effect
from gz_onboard.priors import correlations
from gz_onboard.vehicle import OWN, find_vehicle, read_vehicle

REFERENCE = (OWN / "reference.toml").read_text(encoding="utf-8")
DRAG = r"(drag_area = \{ value = )[\d.]+"
OCV = r"(\[battery.ocv\]\nsoc = .*\nvalue = \[)[\d.]+, "
R0 = r"(\[battery.r0\]\nsoc = .*\ntemperature = .*\nvalue = \[\n  \[)[\d.]+, "


def changed(folder: Path, old: str, new: str) -> tuple[Path, int]:
    """The reference vehicle's file with one change, and the line of the change. old: a regular expression."""
    found = re.search(old, REFERENCE)
    assert found
    file = folder / "mine.toml"
    file.write_text(re.sub(old, new, REFERENCE, count=1), encoding="utf-8")
    return file, REFERENCE.count("\n", 0, found.start()) + 1


@pytest.mark.parametrize("name", sorted(file.stem for file in OWN.glob("*.toml")))
def test_the_packages_own_vehicles_are_whole(name):
    vehicle = read_vehicle(name)
    assert vehicle.battery is not None
    assert {"pack_voltage", "pack_current"} <= {source.role for source in vehicle.mapping.sources}
    assert all(value.source and value.status for value in vehicle.parameters.known.values())
    assert vehicle.name in vehicle.key


ENTROPY = r"(\[battery.entropy\]\nsoc = .*\nvalue = \[)[-\d.e]+, "


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r'unit = "V/K"', 'unit = "mV/K"', "battery.entropy.unit: 'mV/K' is not one of V/K"),
        (ENTROPY, r"\g<1>-0.4, ", "battery.entropy.value: -0.4 is outside -0.005 to 0.005"),
        (ENTROPY, r"\g<1>", "battery.entropy.value: must be 7 numbers, one for each soc"),
    ],
)
def test_an_entropy_that_cannot_be_is_named_with_its_line(tmp_path, old, new, message):
    file, _ = changed(tmp_path, old, new)
    with pytest.raises(InputError, match=rf"mine.toml:\d+: {re.escape(message)}"):
        read_vehicle(str(file))


def test_the_key_tells_what_a_saved_state_belongs_to(tmp_path):
    ours = read_vehicle("reference").key
    for old, new in [(r'"grade_force",\s+', ""), ("cells_series = 14", "cells_series = 13"), ("-scooter", "-2")]:
        assert read_vehicle(str(changed(tmp_path, old, new)[0])).key != ours
    assert read_vehicle(str(changed(tmp_path, DRAG, r"\g<1>0.4567")[0])).key == ours


def test_a_vehicle_that_is_not_there():
    with pytest.raises(InputError, match=r"refrence: no such vehicle file; .*reference.*did you mean 'reference'"):
        find_vehicle("refrence")
    with pytest.raises(InputError, match=r"\./reference: no such vehicle file; .*did you mean 'reference'"):
        find_vehicle("./reference")


# --- effects that come with a file are code -----------------------------------------------------------------------

EFFECT = """
from gz_onboard.model.effect import Parameter, Port
open(__file__ + ".ran", "w").close()
PORT = Port.DC_POWER
PARAMETERS = (Parameter("horn_power", "W", 5.0, 1.0, 0.0, 50.0, "a guess"),)
def term(*, horn_power):
    return horn_power
"""


def with_effect(folder: Path, effects_folder: str = "effects", where: str = "effects") -> Path:
    """A vehicle file with an effect of its own, `horn`."""
    (folder / where).mkdir(parents=True, exist_ok=True)
    (folder / where / "horn.py").write_text(EFFECT)
    file = folder / "v.toml"
    listed = f'[model]\neffects_folder = "{effects_folder}"\neffects = ["horn", '
    file.write_text(REFERENCE.replace("[model]\neffects = [", listed))
    return file


def refusal(file: Path, **options) -> str:
    """Why the file is refused, with nothing of it run."""
    with pytest.raises(InputError) as caught:
        read_vehicle(file, **options)
    assert not list(file.parent.parent.rglob("*.ran"))
    return str(caught.value)


def test_the_effects_of_ones_own_file_run(tmp_path):
    assert "horn" in read_vehicle(with_effect(tmp_path)).key


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("import sys; sys.exit('bye')", "SystemExit: bye"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("import asyncio; raise asyncio.CancelledError('x')", "CancelledError: x"),
        ("PARAMETERS = 5", "TypeError: 'int' object is not iterable"),
        ("PARAMETERS = (1,)", "AttributeError: 'int' object has no attribute 'name'"),
        ("term = 5", "TypeError: 5 is not a callable object"),
    ],
)
def test_an_effect_whose_code_fails_is_named(tmp_path, line, told):
    file = with_effect(tmp_path)
    effect = file.parent / "effects" / "horn.py"
    effect.write_text(f"{EFFECT}\n{line}\n")
    for load in (lambda: read_vehicle(file), lambda: load_effect("horn", effect.parent)):
        with pytest.raises(InputError, match=re.escape(f"{effect}: {told}")):
            load()


def test_only_the_effects_source_is_run(tmp_path):
    """Bytecode beside it can be another's: in a folder with the sticky bit, as /tmp, anybody may add some."""
    file = with_effect(tmp_path)
    effect = file.parent / "effects" / "horn.py"
    other = tmp_path / "other.py"
    other.write_text(EFFECT.replace("5.0, 1.0", "6.0, 1.0"))
    stamp = effect.stat().st_mtime_ns
    os.utime(other, ns=(stamp, stamp))
    py_compile.compile(str(other), cfile=importlib.util.cache_from_source(str(effect)), doraise=True)
    assert load_effect("horn", effect.parent).parameters[0].prior == 5.0


@pytest.mark.parametrize("others", ["effects/horn.py", "effects", "v.toml", "."])
def test_effects_that_others_can_change_do_not_run(tmp_path, others):
    file = with_effect(tmp_path / "a")
    place = file.parent / others
    place.chmod(place.stat().st_mode | 0o002)
    said = refusal(file)
    assert f"{place} can be written by others" in said
    assert re.search(r"v\.toml:\d+: model\.effects: horn\.py", said)
    assert "--effects" in said
    assert "horn" in read_vehicle(file, effects_folder=file.parent / "effects").key


@pytest.mark.parametrize("folder", ["/tmp", "../elsewhere", "effects/../../elsewhere", "link"])
def test_effects_from_elsewhere_do_not_run(tmp_path, folder):
    file = with_effect(tmp_path / "a", folder, where="../elsewhere")
    (tmp_path / "a" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "a" / "effects").mkdir()
    assert "is not below the vehicle file's own folder" in refusal(file)


# line: where the error must point to, counted from the change
@pytest.mark.parametrize(
    ("old", "new", "line", "parts"),
    [
        ("schema = 1", "schema = 2", 0, ["schema", "is 2", "reads 1"]),
        ("schema = 1\n", "", None, ["schema", "is missing"]),
        ('name = "reference-scooter"\n', "", None, ["name", "is missing"]),
        ("schema = 1", "schema = 1\nspeed = 3", 1, ["speed", "unknown key", "known are battery, bus"]),
        (r"\[parameters\]", "[parameter]", 0, ["parameter", "unknown key", "did you mean 'parameters'"]),
        (r"drag_area = \{", "drag_aria = {", 0, ["parameters.drag_aria", "unknown key", "did you mean 'drag_area'"]),
        (DRAG + ', unit = "m²"', r'\g<1>0.5, unit = "m"', 0, ["parameters.drag_area.unit", "'m'", "'m²'"]),
        (DRAG, r"\g<1>556", 0, ["parameters.drag_area.value", "556 m² is outside", " m²"]),
        (DRAG, r"\g<1>nan", 0, ["parameters.drag_area.value", "finite", "nan"]),
        (DRAG, r'\g<1>"0.5"', 0, ["drag_area.value", "must be a number"]),
        (r"drag_area = \{ value", "drag_area = { valeu", 0, ["drag_area.valeu", "unknown key", "did you mean 'value'"]),
        (r"(drag_area = .*), sd = [\d.]+", r"\1, sd = -1", 0, ["parameters.drag_area.sd", "-1 is outside"]),
        (
            r'(drag_area = .*status = )"measured"',
            r'\1"mesured"',
            0,
            ["drag_area.status", "'mesured'", "did you mean 'measured'"],
        ),
        ('"aerodynamic_drag"', '"areodynamic_drag"', -1, ["model.effects", "did you mean 'aerodynamic_drag'"]),
        (r"\[model\]\n", '[model]\neffects_folder = "none"\n', 1, ["model.effects_folder", "no folder", "none"]),
        ("cells_series = 14", "cells_series = 0", 0, ["battery.cells_series", "0 is outside 1 to"]),
        ("cells_series = 14", "cells_series = 14.5", 0, ["battery.cells_series", "whole number", "14.5"]),
        ('"vehicle.dbc"', f'"{"x" * 5000}"', 0, ["dbc", "cannot be the name of a file"]),
        (
            r"\[model\]\n",
            '[model]\neffects_folder = "\\\\u0000"\n',
            1,
            ["effects_folder", "cannot be the name of a file"],
        ),
        ('"aerodynamic_drag"', f'"{"x" * 5000}"', -1, ["model.effects", "cannot be the name of a file"]),
        ('"reference-scooter"', '"../../etc"', 0, ["name", "'../../etc'", "letter or digit first"]),
        ('"reference-scooter"', '"a\\\\u0000"', 0, ["name"]),
        (r"effects = \[[^]]*\]", "effects = []", 0, ["model.effects", "list of names"]),
        (DRAG, rf"\g<1>1{'0' * 400}", 0, ["drag_area.value", "finite"]),
        (r"(drag_area = .*), sd = [\d.]+", r"\1, sd = 1e300", 0, ["drag_area.sd", "outside 0 to 1e+09"]),
        (r"(\[battery.ocv\]\nsoc = \[[\d.]+), [\d.]+", r"\1, 5e-324", 1, ["battery.ocv.soc", "must increase"]),
        (
            r"\[battery.ocv\]\nsoc = .*\nvalue = .*",
            "[battery.ocv]\nsoc = [0.4, 0.9]\nvalue = [3.0, 4.0]",
            1,
            ["battery.ocv.soc", "0.1 or less"],
        ),
        (r"(\[battery.capacity\]\n.*\nvalue = \[)[\d.]+", r"\g<1>900.0", 2, ["capacity.value", "0.05 to 2 times"]),
        ("cells_series = 14", "cell_series = 14", 0, ["battery.cell_series", "did you mean 'cells_series'"]),
        ("cells_series = 14", "", -1, ["battery.cells_series", "is missing"]),
        (r"(\[battery.ocv\]\nsoc = \[[\d.]+), [\d.]+", r"\1, 0.0", 1, ["battery.ocv.soc", "increase"]),
        (OCV, r"\g<1>2.95, ", 2, ["ocv.value", "must increase, but 2.", "follows 2.95"]),
        (OCV, r"\1", 2, ["battery.ocv.value", "must be 29 numbers, one for each soc"]),
        (
            r"(\[battery.ocv\]\n.*\nvalue = \[.*), [\d.]+\]",
            r"\1, 5.1]",
            2,
            ["battery.ocv.value", "5.1 is outside 0.5 to 5"],
        ),
        ('unit = "A·h"\nsd_relative', 'unit = "Ah"\nsd_relative', 0, ["battery.capacity.unit", "'Ah'", "A·h"]),
        (r"\[battery.c1\]", "[battery.c2]", 0, ["battery.c2", "unknown key", "did you mean 'c1'"]),
        (R0, r"\1", 3, ["battery.r0.value", "14 numbers (in ohm, one for each soc)"]),
        (R0, r"\1-0.2769, ", 3, ["battery.r0.value", "-0.2769 is outside"]),
        ('pack_voltage = "BMS_PackVoltage"', 'pack_voltage = "BMS_PackVolts"', 0, ["did you mean 'BMS_PackVoltage'"]),
    ],
)
def test_a_file_that_does_not_fit(tmp_path, old, new, line, parts):
    file, number = changed(tmp_path, old, new)
    with pytest.raises(InputError) as caught:
        read_vehicle(str(file))
    message = str(caught.value)
    for part in [str(file), *parts]:
        assert part in message
    told = re.search(r"mine\.toml:(\d+):", message)
    if line is None:
        assert not told
    else:
        assert told and int(told[1]) == number + line, message


CORRELATION = """
[correlation.coastdown]
parameters = ["drag_area", "rolling_resistance_constant"]
value = [[1.0, 0.86], [0.86, 1.0]]
"""


def with_correlation(folder: Path, text: str) -> Path:
    file = folder / "mine.toml"
    file.write_text(re.sub(r"(?ms)^\[correlation.*?(?=^\[[^\[\d]|\Z)", "", REFERENCE) + text, encoding="utf-8")
    return file


def test_parameters_that_were_found_together_are_tied(tmp_path):
    tied = correlations(read_vehicle(str(with_correlation(tmp_path, CORRELATION))))
    assert tied == {frozenset(("drag_area", "rolling_resistance_constant")): 0.86}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"drag_area"', '"drag_aera"', "no parameter is called 'drag_aera' (did you mean 'drag_area'?)"),
        ("[0.86, 1.0]]", "[0.85, 1.0]]", "not symmetric"),
        ("[[1.0, 0.86]", "[[1.0, 1.86]", "1.86 is outside -1 to 1"),
        ("[[1.0, 0.86], ", "[", "must be 2 rows of 2 numbers"),
        ("[[1.0", "[[0.9", "diagonal must be 1"),
        ('"rolling_resistance_constant"]', '"drag_area"]', "names 'drag_area' twice"),
        (
            'constant"]\nvalue = [[1.0, 0.86], [0.86, 1.0]]',
            'constant", "wheelbase"]\nvalue = [[1, 0.9, 0.9], [0.9, 1, -0.9], [0.9, -0.9, 1]]',
            "a variance is negative",
        ),
        (
            'constant"]\nvalue = [[1.0, 0.86], [0.86, 1.0]]',
            'constant", "wheelbase"]\nvalue = [[1, 0.9, 0.9], [0.9, 1, 0.61], [0.9, 0.61, 1]]',
            "a variance is negative",
        ),
    ],
)
def test_a_correlation_that_is_none_is_refused(tmp_path, old, new, says):
    file = with_correlation(tmp_path, CORRELATION.replace(old, new))
    assert read_vehicle(str(file)).battery  # nothing on board needs them
    with pytest.raises(InputError, match=r"mine\.toml:\d+: correlation\.coastdown") as error:
        gz_onboard.read_vehicle(str(file))
    assert says in str(error.value)
