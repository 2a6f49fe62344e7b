"""Units against closed forms, and every printed unit read back."""

import math
import threading
from contextvars import copy_context

import pytest

from kf_calib.bench.bench import Bench
from kf_calib.effects import effect_named, names
from kf_calib.errors import InputError
from kf_calib.support import units
from kf_calib.support.units import Unit, field_unit, quantity, rounded, shown, shown_in, shown_whole, si, significant
from kf_calib.views import noise

G = 9.80665  # m/s^2, by definition
ARCSEC = math.pi / 180 / 3600
BENCH = Bench.from_metadata({"axes": "y z x", "latitude_deg": "50"})
QUANTITIES = {c.symbol: c for name in names(BENCH) for c in effect_named(name, BENCH).coefficients}
QUANTITIES["qb"] = effect_named("bias-walk", BENCH).intensity


@pytest.mark.parametrize(
    ("unit", "label", "in_si"),
    [
        ("rad", "arcsec", ARCSEC),
        ("1", "ppm", 1e-6),
        ("m/s^2", "µg", 1e-6 * G),
        ("s^2/m", "µg/g²", 1e-6 * G / G**2),
        ("s^4/m^2", "µg/g³", 1e-6 * G / G**3),
        ("rad s^2/m", "arcsec/g", ARCSEC / G),
        ("m/s^3", "µg/h", 1e-6 * G / 3600),
        ("1/s", "ppm/h", 1e-6 / 3600),
        ("rad/s", "µrad/day", 1e-6 / 86400),
        ("m/s^2/K", "µg/K", 1e-6 * G),
        ("m/s^2/K^2", "µg/K²", 1e-6 * G),
        ("1/K", "ppm/K", 1e-6),
        ("rad/K", "µrad/K", 1e-6),
        ("m s^-1/K", "µg per K/min", 1e-6 * G * 60),
        ("m/s^2/s^(1/2)", "µg/√s", 1e-6 * G),
        ("Hz", "Hz", 1.0),
    ],
)
def test_one_unit_of_the_field_for_each_si_unit(unit: str, label: str, in_si: float) -> None:
    assert field_unit(unit).label == label
    assert field_unit(unit).per_si == pytest.approx(1 / in_si, rel=1e-14)


def test_the_table_holds_no_unit_that_nothing_is_in() -> None:
    of_noise = {unit for sizes in noise._SI.values() for unit in sizes}
    assert set(units._FIELD) <= {c.unit for c in QUANTITIES.values()} | of_noise


@pytest.mark.parametrize("symbol", QUANTITIES)
def test_a_size_as_it_is_printed_is_read_back(symbol: str) -> None:
    """All but those whose label is in words or has a root."""
    own = QUANTITIES[symbol]
    if " " in own.shown_unit or "√" in own.shown_unit:
        pytest.skip("no unit that a user would write")
    for system in ("field", "si"):
        with shown_in(system):
            assert quantity(shown(own).text(0.125 / own.per_si, 12), own.unit) == pytest.approx(0.125 / own.per_si)


def test_people_are_shown_the_field_s_units_or_si() -> None:
    qb = QUANTITIES["qb"]
    assert (shown("m/s^2").label, shown(qb).label) == ("µg", "µg/√s")
    assert shown_whole("rad") == Unit("deg", math.degrees(1.0)) and shown_whole("K/s") == Unit("K/h", 3600.0)
    assert [shown_whole("s", each).label for each in (299.0, 301.0)] == ["s", "min"]
    with shown_in("si"):
        assert shown("m/s^2") == Unit("m/s^2", 1.0) and shown(qb) == Unit(qb.unit, 1.0)
        assert shown_whole("rad") == Unit("rad", 1.0) and shown_whole("s") == Unit("s", 1.0)
        said = list[str]()
        other = threading.Thread(target=copy_context().run, args=(lambda: said.append(shown("rad").label),))
        other.start()
        other.join()
        assert said == ["rad"]
    assert shown("rad").label == "arcsec"


def test_numbers_as_they_are_printed() -> None:
    assert shown("m/s^2").text(3e-6 * G) == "3 µg"
    printed = ["1230", "-1230000", "0.00123", "1.5e+12"]
    assert [significant(value) for value in (1234.5, -1.2345e6, 0.001234, 1.5e12)] == printed
    assert rounded(1.23456, 0.0123) == ("1.235", "0.012") and rounded(12345.6, 123.4) == ("12346", "123")
    assert rounded(1.5, math.nan) == ("1.5", "nan")


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("1 arcsec", "rad", ARCSEC), ("2e-3deg", "rad", math.radians(2e-3)), ("5", "rad", 5.0),
        ("3ug", "m/s^2", 3e-6 * G),
        ("3µg", "m/s^2", 3e-6 * G), ("3μg", "m/s^2", 3e-6 * G), ("4 m/s2", "m/s^2", 4.0), ("4m/s^2", "m/s^2", 4.0),
        ("5um/s2", "m/s^2", 5e-6), ("10ppm", "1", 1e-5), ("1%", "1", 0.01), ("4µg/g²", "s^2/m", 4e-6 / G),
        ("2 mps2*h", "m/s", 7200.0), ("1e-3 rad s^2/m", "rad s^2/m", 1e-3),
    ],
)  # fmt: skip
def test_what_a_user_writes(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit) == pytest.approx(value, rel=1e-14) == pytest.approx(si(text), rel=1e-14)


@pytest.mark.parametrize(
    ("text", "unit", "why"),
    [
        ("3 ug", "rad", "not in a unit of this kind: use rad, mrad, urad, deg, arcmin, arcsec"),
        ("1 rad", "1", "use 1, ppm, permille, %"),
        ("3 parsec", "rad", "unit 'parsec' is not known"),
        ("3,5 ug", "m/s^2", "write 3.5 with a point"),
        ("much", "m/s^2", "is not a number"),
        ("1e999", "rad", "not a finite number"),
    ],
)
def test_what_is_no_quantity_of_that_kind_is_refused(text: str, unit: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        quantity(text, unit)


def test_a_value_and_its_sigma_have_one_form() -> None:
    unit = Unit("µg/g²", 1.0)
    assert unit.with_sigma(-2.49123e9, 1.6e8) == "-2.49e+09 ± 0.16e+09 µg/g²"
    assert unit.with_sigma(2.99e-10, 1.2e-11) == "2.99e-10 ± 0.12e-10 µg/g²"
    assert unit.with_sigma(0.0, 1.2e-11) == "0.0e-11 ± 1.2e-11 µg/g²"
    assert unit.with_sigma(-1234.5, 66.0) == "-1234 ± 66 µg/g²"
    assert unit.with_sigma(2.8, 0.038) == "2.800 ± 0.038 µg/g²"
