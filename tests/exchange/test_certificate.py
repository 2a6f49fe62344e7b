"""Certificates: the budget against recalibrations, the XML and the PDF against the calibration."""

from __future__ import annotations

import io
import json
import math
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import SYMBOLS, Run

from kf_calib import calibrate
from kf_calib.bench import paper_parameters
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import InputError
from kf_calib.estimation.results import Calibration
from kf_calib.estimation.settings import Settings
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.certificate import content, dcc, document, statement
from kf_calib.exchange.certificate.budget import COVERAGE, Budget, Contribution, budget, coverage_factor
from kf_calib.exchange.certificate.statement import TypeB
from kf_calib.support.extras import MissingExtraError

ARCSEC = math.radians(1.0 / 3600.0)
sets = pytest.mark.skipif(find_spec("typst") is None, reason="typst is not there: no PDF is made")
reads = pytest.mark.skipif(shutil.which("pdftotext") is None, reason="pdftotext (poppler-utils) is not there")
LAB = """
number = "2026-0147"
issued = 2026-11-23
received = 2025-06-10
site = "laboratory"
traceability = "Angles: certificate A-311."
decision_rule = "guard band"
laboratory = { name = "Example Laboratory", city = "Berlin", country = "DE" }
customer = { name = "Example Customer", city = "Bristol", country = "GB" }
item = { name = "Block of three accelerometers", serial = "0042" }
persons = [{ name = "A. Metrologist", role = "Head" }]
limits = { K = "500 ppm", b = "100 ug" }
[[uncertainty]]
effect = "gravity-error"
size = "2 ppm"
k = 2.0
source = "report G-27"
[[uncertainty]]
effect = "axis-nonorthogonality:z"
size = "2 arcsec"
dof = 8.0
"""


class Misread(Run):
    """A run whose encoders read otherwise than the gimbals stand."""

    offset_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __iter__(self) -> Iterator[Batch]:
        for batch in super().__iter__():
            yield Batch(batch.accel, Stream(batch.pose.time_ns, batch.pose.values + np.array(self.offset_rad)))


def quiet(**options: Any) -> Misread:
    """A run with next to no noise, whose scatter and setting error are stated as none."""
    run = Misread(seed=3, white_mps2=1e-9, **options)
    run.bench = replace(run.bench, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0)
    return run


def values(result: Calibration) -> np.ndarray:
    return np.array([result.parameters[symbol].value for symbol in SYMBOLS])


@pytest.fixture(scope="module")
def saved() -> SavedCalibration:
    return calibration_file.saved(calibrate(quiet()))


@pytest.fixture(scope="module")
def cal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of a recording, as a file."""
    path = tmp_path_factory.mktemp("cal") / "cal.json"
    own = calibrate(ROOT / "recordings" / "navigation_24.mcap")
    calibration_file.write(path, calibration_file.saved(own, "navigation_24.mcap", "0" * 64, 1_750_000_000 * 10**9))
    return path


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(LAB)
    return path


def made(cal: Path, lab: Path | None) -> content.Certificate:
    saved, own = calibration_file.read(cal), statement.read(lab)
    earlier = None if own.before is None else calibration_file.read(own.before)
    return content.certificate(saved, saved.model(), own, None if earlier is None else (earlier, earlier.model()))


@pytest.mark.parametrize(("gimbal", "letter"), list(enumerate("yzx")))
def test_a_shifted_encoder_moves_the_parameters_as_its_sensitivity_says(
    saved: SavedCalibration, gimbal: int, letter: str
) -> None:
    run = quiet()
    run.offset_rad = tuple(np.eye(3)[gimbal] * -ARCSEC)  # the gimbal stands ahead of what the encoder reads
    moved = values(calibrate(run)) - saved.twelve[0]
    _, line = budget(saved, saved.model(), [TypeB(effect=f"encoder-offset:{letter}", size="1 arcsec")]).contributions
    assert line.sensitivity is not None
    assert moved == pytest.approx(line.sensitivity * ARCSEC, abs=2e-3 * ARCSEC)
    assert line.parts == pytest.approx(np.abs(moved), abs=2e-3 * ARCSEC)


def test_a_wrong_gravity_is_a_common_scale(saved: SavedCalibration) -> None:
    run = quiet()
    run.bench = replace(run.bench, gravity_mps2=run.bench.gravity_mps2 / (1 + 1e-5))
    moved = values(calibrate(run)) - saved.twelve[0]
    _, line = budget(saved, saved.model(), [TypeB(effect="gravity-error", size="10 ppm", k=2.0)]).contributions
    assert 2.0 * line.parts == pytest.approx(np.abs(moved), abs=1e-9)
    assert line.parts[[2, 6, 10]] == pytest.approx(saved.twelve[0][[2, 6, 10]] * 5e-6)


def test_what_differs_from_dwell_to_dwell_adds_as_noise_does(saved: SavedCalibration) -> None:
    """A bias of 1 m/s^2 of accelerometer 2, drawn anew in each of the dwells, which weigh by their readings."""
    wild = TypeB(effect="thermal-bias", size="2 mps2/K", temperature="0.5 K", varies="dwell")
    line = budget(saved, saved.model(), [wild]).contributions[2]
    poses = np.radians([dwell.gimbal_deg for dwell in saved.conditions.dwells])
    force = saved.bench.specific_force(np.zeros(len(poses)), poses)
    rows = np.column_stack([force, np.ones(len(force))])
    jacobian = paper_parameters.jacobian(np.array(saved.state.values[:12]))[4:8, 4:8]
    weighted = rows.T * [dwell.readings for dwell in saved.conditions.dwells]
    expected = np.linalg.norm(jacobian @ np.linalg.inv(weighted @ rows) @ weighted, axis=1)
    assert line.parts[4:8] == pytest.approx(expected, rel=1e-6)
    assert line.parts[[0, 1, 2, 3, 8, 9, 10, 11]] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("distribution", "divisor"), [("rectangular", 3.0), ("triangular", 6.0), ("arcsine", 2.0)])
def test_half_a_width_becomes_a_standard_uncertainty(
    saved: SavedCalibration, distribution: Any, divisor: float
) -> None:
    own = TypeB(effect="encoder-offset:z", size="1 arcsec", distribution=distribution)
    assert budget(saved, saved.model(), [own]).contributions[1].standard == pytest.approx(ARCSEC / math.sqrt(divisor))


def test_an_effect_in_the_model_is_no_error_of_the_result_any_more() -> None:
    own = calibration_file.saved(calibrate(quiet(), Settings(effects=("encoder-offset:z",))))
    _, line = budget(own, own.model(), [TypeB(effect="encoder-offset:z", size="1 arcsec")]).contributions
    assert line.parts == pytest.approx(0.0, abs=1e-9 * ARCSEC)


def test_what_needs_temperatures_of_dwells_is_left_out_and_said(saved: SavedCalibration) -> None:
    """A file whose model has an effect of temperature."""
    state = saved.state.model_copy(update={
        "symbols": [*saved.state.symbols, "alpha1", "alpha2", "alpha3"],
        "values": [*saved.state.values, 0.0, 0.0, 0.0],
        "covariance": np.pad(np.array(saved.state.covariance), (0, 3)).tolist(),
    })  # fmt: skip
    effect = calibration_file.SavedEffect(text="thermal-bias")
    own = saved.model_copy(update={"state": state, "effects": [effect]})
    found = budget(own, own.model(), [TypeB(effect="gravity-error", size="1 ppm")])
    assert found.left_out == ("thermal-bias",)


def line(parts: float, dof: float) -> Contribution:
    return Contribution("u", "", "B", None, "", "normal", dof, None, None, np.full(12, parts))


def test_effective_degrees_of_freedom_are_those_of_welch_and_satterthwaite() -> None:
    assert Budget((line(1.0, 5.0), line(1.0, 5.0))).dof == pytest.approx(10.0)
    three = Budget((line(3.0, 4.0), line(4.0, math.inf), line(0.0, 1.0)))
    assert three.combined == pytest.approx(5.0)
    assert three.dof == pytest.approx(5.0**4 / (3.0**4 / 4.0))
    assert three.expanded == pytest.approx(5.0 * coverage_factor(np.array([30.0]))[0])
    assert np.isinf(Budget((line(1.0, math.inf),)).dof).all()


def test_coverage_factors_are_those_of_the_gum() -> None:
    """Table G.2 for 95.45 %."""
    dof = np.array([1.0, 2.0, 5.0, 10.9, 20.0, 50.0, math.inf])
    assert coverage_factor(dof) == pytest.approx([13.97, 4.53, 2.65, 2.28, 2.13, 2.05, 2.0], abs=0.005)
    assert COVERAGE == pytest.approx(0.9545, abs=1e-5)


@pytest.mark.parametrize(
    ("deviation", "rule", "outcome"),
    [(0.9, "simple acceptance", "pass"), (1.01, "simple acceptance", "fail"), (0.79, "guard band", "pass"),
     (0.9, "guard band", "conditionalPass"), (1.1, "guard band", "conditionalFail"), (1.21, "guard band", "fail")],
)  # fmt: skip
def test_conformity(deviation: float, rule: Any, outcome: str) -> None:
    assert content.conformity(deviation, 1.0, 0.2, rule) == outcome


def test_the_numbers_of_the_xml_are_those_of_the_calibration(cal: Path, lab: Path) -> None:
    own = made(cal, lab)
    root, names = ET.fromstring(dcc.xml(own)), {"dcc": dcc.DCC, "si": dcc.SI}
    reals = root.findall(".//dcc:result//si:real", names)
    values, _ = own.saved.twelve
    assert [real.findtext("si:label", None, names) for real in reals] == SYMBOLS
    assert [float(real.findtext("si:value", "", names)) for real in reals] == values.tolist()
    units = dict(zip(SYMBOLS, (real.findtext("si:unit", None, names) for real in reals), strict=True))
    assert [units[each] for each in ("theta1", "nu2", "K3", "b2")] == [
        r"\radian", r"\radian", r"\one", r"\metre\second\tothe{-2}"
    ]  # fmt: skip
    spreads = [float(real.findtext(".//si:valueExpandedMU", "", names)) for real in reals]
    factors = [float(real.findtext(".//si:coverageFactor", "", names)) for real in reals]
    assert spreads == own.budget.expanded.tolist() and factors == own.budget.k.tolist()
    outcomes = [each.text for each in root.findall(".//dcc:conformity", names)]
    assert len(outcomes) == 6 and set(outcomes) == {"pass", "fail"}
    assert dcc.check(dcc.xml(own), None).startswith("all mandatory elements of DCC 3.3.0 are there")


def test_without_a_statement_it_says_that_it_is_no_dcc(cal: Path) -> None:
    own = made(cal, None)
    assert "laboratory.name" in own.missing and "begun" not in own.missing
    assert dcc.xml(own).decode().splitlines()[2].startswith(" <!-- not a DCC: not stated are number, site")
    assert dcc.check(dcc.xml(own), None) == "not a DCC: 10 mandatory elements are not stated"


def test_a_schema_that_is_given_decides(cal: Path, lab: Path, tmp_path: Path) -> None:
    pytest.importorskip("xmlschema", reason="xmlschema is not there")
    schema = tmp_path / "own.xsd"
    form = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="https://ptb.de/dcc">
      <xs:element name="digitalCalibrationCertificate"><xs:complexType>
      <xs:sequence><xs:any namespace="##any" processContents="skip" maxOccurs="{}"/></xs:sequence>
      <xs:anyAttribute namespace="##any" processContents="skip"/></xs:complexType></xs:element></xs:schema>"""
    written = dcc.xml(made(cal, lab))
    schema.write_text(form.format(2))
    assert dcc.check(written, schema) == "valid by own.xsd"
    schema.write_text(form.format(1))
    with pytest.raises(InputError, match=r"not valid by it at /.*digitalCalibrationCertificate"):
        dcc.check(written, schema)
    schema.write_text("<xs:schema")
    with pytest.raises(InputError, match="cannot be read as an XML Schema"):
        dcc.check(written, schema)


@sets
@reads
def test_the_pdf_has_every_number_and_the_xml(cal: Path, lab: Path, tmp_path: Path) -> None:
    own = made(cal, lab)
    xml = dcc.xml(own)
    text = text_of(document.pdf(own, xml, "checked"), tmp_path)
    shown = document.content(own, "checked")
    for row in shown["results"]:
        assert f"{row['value']['text']} " in text and row["expanded"]["text"] in text
        assert f"{row['small']['text']} {row['small_unit']}" in text
    for row in (*shown["contributions"], *shown["sensitivities"]):
        assert " ".join(row["values"]) in text
    for row in shown["conformity"]:
        assert f"{row['limit']['text']} {row['unit']} {row['outcome']}" in text
    pages = text.count("Certificate no. 2026-0147")
    assert pages > 1 and all(f"Page {k} of {pages}" in text for k in range(1, pages + 1))
    if shutil.which("pdfdetach"):
        subprocess.run(["pdfdetach", "-saveall", "-o", tmp_path, tmp_path / "made.pdf"], check=True)
        assert (tmp_path / document.ATTACHED).read_bytes() == xml


def text_of(pdf: bytes, folder: Path) -> str:
    (folder / "made.pdf").write_bytes(pdf)
    command = ["pdftotext", "-layout", folder / "made.pdf", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return " ".join(done.stdout.decode().split())


@sets
@reads
def test_what_is_not_stated_stays_blank(cal: Path, tmp_path: Path) -> None:
    text = text_of(document.pdf(made(cal, None), b"<a/>", "not a DCC"), tmp_path)
    for field in ("Certificate number", "Laboratory", "Customer", "Issued", "Humidity", "Traceability"):
        assert f"{field} not stated" in text
    assert "The attached XML is not a DCC" in text and "No claim of accreditation is made." in text
    assert "No error of the bench is stated" in text


HOSTILE = r"""#panic("x") #import "/etc/passwd" $x$ [[ <script>&amp; "'` \u{41} *b* _i_ @ref // ]]> -- ~ éß Ω"""


@sets
@reads
def test_text_of_files_is_data_never_markup(cal: Path, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(f"remarks = {json.dumps(HOSTILE)}\n[laboratory]\nname = {json.dumps(HOSTILE)}\n")
    own = made(cal, path)
    xml = dcc.xml(own)
    assert HOSTILE in [each.text for each in ET.fromstring(xml).iter(f"{{{dcc.DCC}}}content")]
    assert HOSTILE in text_of(document.pdf(own, xml, "checked"), tmp_path)


@sets
def test_the_same_date_gives_the_same_bytes(cal: Path, lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1795000000")
    first, second = (document.pdf(made(cal, lab), dcc.xml(made(cal, lab)), "checked") for _ in range(2))
    assert first == second and b"pdfaid:part>3<" in first and b"pdfuaid:part>1<" in first
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1795000001")
    assert document.pdf(made(cal, lab), dcc.xml(made(cal, lab)), "checked") != first


def test_without_typst_it_says_what_to_install(cal: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kf_calib.support.extras.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"a certificate needs typst, .* pip install 'kf_calib\[report\]'"):
        document.pdf(made(cal, None), b"<a/>", "checked")


@pytest.mark.parametrize(
    ("text", "said"),
    [('nummer = "1"', "nummer: this key is not known"), ("number = 1", "number: Input should be a valid string"),
     ('number = " "', "number: must be text without control"),
     ('number = "a\\u001b[2J"', "number: must be text without control"),
     ('laboratory = {country = "de"}', "laboratory.country: must be text"), ("number", "is not TOML"),
     ('limits = {K = "1 ppm"}', "without the rule by which conformity is decided"),
     ("before = 1", "before: "), ('limits = {K = "1 deg"}', "limits: .*1 deg"),
     ('uncertainty = [{effect = "gravity-error", size = "1 ppm", k = 0.0}]', "uncertainty.0.k: .*greater than 0")],
)  # fmt: skip
def test_a_wrong_statement_is_one_sentence(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as error:
        statement.read(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("own", "said"),
    [(TypeB(effect="gravity", size="1 ppm"), "did you mean gravity-error"),
     (TypeB(effect="gravity-error", size="1 arcsec"), "not in a unit of this kind"),
     (TypeB(effect="thermal-bias", size="1 ug/K"), "say by how much the temperature may be off"),
     (TypeB(effect="latency", size="1 ms"), "name an effect that shows in dwells")],
)  # fmt: skip
def test_an_error_that_cannot_be_carried_is_one_sentence(saved: SavedCalibration, own: TypeB, said: str) -> None:
    with pytest.raises(InputError, match=said):
        budget(saved, saved.model(), [own])


def test_a_run_without_anything_left_over_needs_its_noise_stated(saved: SavedCalibration) -> None:
    own = saved.model_copy(update={
        "noise": saved.noise.model_copy(update={"dwell_sigma_stated": False}),
        "consistency": saved.consistency.model_copy(update={"dof": 0}),
    })  # fmt: skip
    with pytest.raises(InputError, match="state --angle-sigma"):
        budget(own, own.model(), [])


def test_before_adjustment_is_shown_beside(cal: Path, lab: Path) -> None:
    lab.write_text(f"before = {json.dumps(str(cal))}\n{LAB}")
    own = made(cal, lab)
    for each in own.results:
        assert each.before == pytest.approx((each.value, each.expanded))
    assert len(document.content(own, "")["adjustment"]) == 12


@sets
def test_the_command_writes_both_files(run: Any, cal: Path, lab: Path, tmp_path: Path) -> None:
    pdf, xml = tmp_path / "c.pdf", tmp_path / "c.xml"
    code, out, err = run("certificate", cal, "--statement", lab, "-o", pdf, "--xml", xml, "--json")
    assert code == 0, err
    printed = json.loads(out)
    assert printed["number"] == "2026-0147" and printed["not_stated"] == []
    assert [each["kind"] for each in printed["budget"]] == ["A", "B", "B", "B"]
    assert pdf.read_bytes().startswith(b"%PDF-") and ET.parse(io.BytesIO(xml.read_bytes()))
    earlier = tmp_path / "earlier.json"
    earlier.write_bytes(cal.read_bytes())
    lab.write_text(f'before = "earlier.json"\n{LAB}')  # counts from the statement
    for out in (lab, earlier):
        code, _, err = run("certificate", cal, "-o", out, "--statement", lab, "--overwrite")
        assert code == 2 and "is read by this very command" in err


def test_what_the_run_does_not_determine_has_no_number(saved: SavedCalibration) -> None:
    first = saved.parameters[0].model_copy(update={"value": None, "sigma": None})
    own = saved.model_copy(update={"parameters": [first, *saved.parameters[1:]]})
    made = content.certificate(
        own, own.model(), statement.Statement(limits={"theta": "1 deg"}, decision_rule="guard band")
    )
    assert [each.value is None for each in made.results] == [True] + [False] * 11
    assert [each.conformity for each in made.results if each.limit] == [None, "pass"]
    root, names = ET.fromstring(dcc.xml(made)), {"dcc": dcc.DCC, "si": dcc.SI}
    assert len(root.findall(".//dcc:result//si:real", names)) == 11
    assert root.findtext(".//dcc:noQuantity/dcc:content", None, names) == "not determined by this run"
    shown = document.content(made, "checked")
    assert shown["results"][0]["value"] is None and {row["values"][0] for row in shown["contributions"]} == {"–"}
    assert shown["conformity"][0]["outcome"] == "not determined"


ORDER = {
    "administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer statements",
    "software": "name release type description",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier receiptDate "
    "beginPerformanceDate endPerformanceDate performanceLocation issueDate",
    "item": "name description manufacturer model identifications",
    "identification": "issuer value name",
    "contact": "name eMail phone location",
    "customer": "name eMail phone location",
    "respPerson": "person role mainSigner",
    "statement": "name declaration",
    "measurementResult": "name usedMethods usedSoftware influenceConditions results",
    "usedMethod": "name description norm",
    "influenceCondition": "name data",
    "result": "name data",
    "quantity": "name noQuantity real measurementMetaData",
    "metaData": "name conformity",
    "real": "label value unit measurementUncertaintyUnivariate",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability",
}
"""Elements in the order in which DCC 3.3.0 and D-SI 2.2.1 want them."""


def test_elements_come_in_the_order_of_the_schema(cal: Path, lab: Path) -> None:
    conditions = 'conditions = { temperature = "21 °C", humidity = "45 %" }\n'
    lab.write_text(f'norms = ["IEEE Std 1293"]\nremarks = "None."\n{conditions}{LAB}')
    seen = set[str]()
    for element in ET.fromstring(dcc.xml(made(cal, lab))).iter():
        name, found = element.tag.rpartition("}")[2], [child.tag.rpartition("}")[2] for child in element]
        if name in ORDER and found:
            seen.add(name)
            known = ORDER[name].split()
            assert set(found) <= set(known), name
            assert sorted(found, key=known.index) == found, name
    assert seen == set(ORDER)
