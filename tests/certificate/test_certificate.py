"""Certificates: the budget against recalibrations, the XML and the PDF against the calibration."""

import io
import json
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, date, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.numbered_commands import STATEMENT
from helpers.paths import ROOT
from helpers.synthetic import SYMBOLS

from kf_calib import calibrate
from kf_calib.certificate import budget, dcc, document, statement
from kf_calib.certificate.intrinsic import intrinsic
from kf_calib.errors import InputError, MissingExtraError
from kf_calib.exchange import calibration_file
from kf_calib.support.units import field_unit

sets = pytest.mark.skipif(find_spec("typst") is None, reason="typst is not there: no PDF is made")
reads = pytest.mark.skipif(shutil.which("pdftotext") is None, reason="pdftotext (poppler-utils) is not there")


LAB = (
    """
site = "laboratory"
traceability = "Angles: certificate A-311."
laboratory = { name = "Example Laboratory", city = "Berlin", country = "DE" }
customer = { name = "Example Customer", city = "Bristol", country = "GB" }
item = { name = "Block of three accelerometers", serial = "0042" }
persons = [{ name = "A. Metrologist", role = "Head" }]
"""
    + STATEMENT
)


@pytest.fixture(scope="module")
def cal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of a recording, as a file."""
    path = tmp_path_factory.mktemp("cal") / "cal.json"
    own = calibrate(ROOT / "recordings" / "navigation_24.mcap")
    began = datetime(2025, 6, 15, 15, 6, 40, tzinfo=UTC)
    calibration_file.write_calibration(path, calibration_file.saved(own, "navigation_24.mcap", "0" * 64, began))
    return path


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(LAB)
    return path


def made(cal: Path, lab: Path | None) -> budget.Certificate:
    saved, own = calibration_file.open_calibration(cal), statement.read_statement(lab)
    earlier = None if own.before is None else calibration_file.open_calibration(own.before)
    return budget.certificate(saved, saved.model(), own, None if earlier is None else (earlier, earlier.model()))


@pytest.mark.parametrize(
    ("deviation", "rule", "outcome"),
    [(0.9, "simple acceptance", "pass"), (1.01, "simple acceptance", "fail"), (0.79, "guard band", "pass"),
     (0.9, "guard band", "conditionalPass"), (1.1, "guard band", "conditionalFail"), (1.21, "guard band", "fail")],
)  # fmt: skip
def test_conformity(deviation: float, rule: Any, outcome: str) -> None:
    assert budget.conformity(deviation, 1.0, 0.2, rule) == outcome


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
    assert dcc.check_dcc(dcc.xml(own), None).startswith("all mandatory elements of DCC 3.3.0 are there")


def test_it_says_which_raw_readings_the_results_belong_to(cal: Path) -> None:
    own = made(cal, None)
    assert not any("readings made of" in remark for remark in document.content(own, "")["remarks"])
    bench = dict(own.saved.provenance.bench) | {"channels": "2, -1, 3", "accel_scale": "4e-6"}
    saved = own.saved.model_copy(update={"provenance": own.saved.provenance.model_copy(update={"bench": bench})})
    remarks = document.content(replace(own, saved=saved), "")["remarks"]
    (told,) = [remark for remark in remarks if "readings made of" in remark]
    assert "accelerometers 1, 2, 3 on channels 2, -1, 3: x = 4e-06 channel2, y = -4e-06 channel1, z = 4e-06" in told


def test_without_a_statement_it_says_that_it_is_no_dcc(cal: Path) -> None:
    own = made(cal, None)
    assert "laboratory.name" in own.missing and "begun" not in own.missing
    assert dcc.xml(own).decode().splitlines()[2].startswith(" <!-- not a DCC: not stated are number, site")
    assert dcc.check_dcc(dcc.xml(own), None) == "not a DCC: 10 mandatory elements are not stated"


def test_a_schema_that_is_given_decides(cal: Path, lab: Path, tmp_path: Path) -> None:
    pytest.importorskip("xmlschema", reason="xmlschema is not there")
    schema = tmp_path / "own.xsd"
    form = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="https://ptb.de/dcc">
      <xs:element name="digitalCalibrationCertificate"><xs:complexType>
      <xs:sequence><xs:any namespace="##any" processContents="skip" maxOccurs="{}"/></xs:sequence>
      <xs:anyAttribute namespace="##any" processContents="skip"/></xs:complexType></xs:element></xs:schema>"""
    written = dcc.xml(made(cal, lab))
    schema.write_text(form.format(2))
    assert dcc.check_dcc(written, schema) == "valid by own.xsd"
    schema.write_text(form.format(1))
    with pytest.raises(InputError, match=r"not valid by it at /.*digitalCalibrationCertificate"):
        dcc.check_dcc(written, schema)
    schema.write_text("<xs:schema")
    with pytest.raises(InputError, match="cannot be read as an XML Schema"):
        dcc.check_dcc(written, schema)


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
    pages = text.count("Certificate no. 1 ")
    assert pages > 1 and all(f"Page {k} of {pages}" in text for k in range(1, pages + 1))
    if shutil.which("pdfdetach"):
        subprocess.run(["pdfdetach", "-saveall", "-o", tmp_path, tmp_path / "made.pdf"], check=True, timeout=120)
        assert (tmp_path / document.ATTACHED).read_bytes() == xml


@pytest.mark.parametrize(
    ("largest", "shown"),
    [(0.0, "0.0000"), (0.0099, "9.90e−03"), (0.0101, "0.0101"), (9999.0, "9999.0000"), (10001.0, "1.00e+04")],
)
def test_a_sensitivity_is_shown_with_three_digits_at_least(cal: Path, lab: Path, largest: float, shown: str) -> None:
    own = made(cal, lab)
    line = next(each for each in own.budget.contributions if each.sensitivity is not None)
    per_si = field_unit(own.results[0].unit).per_si / field_unit(line.unit).per_si
    values = np.zeros(12)
    values[0] = largest / per_si
    row = document._sensitivity(own, replace(line, changes=values[:, None]))
    assert row["values"][0] == shown


def text_of(pdf: bytes, folder: Path) -> str:
    (folder / "made.pdf").write_bytes(pdf)
    command = ["pdftotext", "-layout", folder / "made.pdf", "-"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=120)
    return " ".join(done.stdout.decode().split())


@sets
@reads
def test_what_is_not_stated_stays_blank(cal: Path, tmp_path: Path) -> None:
    text = text_of(document.pdf(made(cal, None), b"<a/>", "not a DCC"), tmp_path)
    for field in ("Certificate number", "Laboratory", "Customer", "Issued", "Humidity", "Traceability"):
        assert f"{field} not stated" in text
    assert "The attached XML is not a DCC" in text and "No claim of accreditation is made." in text
    assert "No error of the bench is stated" in text


@pytest.mark.parametrize(
    ("begun", "ended", "shown"),
    [(None, None, None), (date(2025, 6, 15), date(2025, 6, 15), "2025-06-15"),
     (date(2025, 6, 15), date(2025, 6, 16), "2025-06-15 to 2025-06-16")],
)  # fmt: skip
def test_days_of_the_calibration_are_shown_where_they_are_known(
    cal: Path, begun: date | None, ended: date | None, shown: str | None
) -> None:
    facts = document.content(replace(made(cal, None), begun=begun, ended=ended), "checked")["facts"]
    assert dict(facts)["Calibrated"] == shown


@pytest.mark.parametrize(
    ("lowest_c", "highest_c", "shown"),
    [(None, None, None), (19.5, 21.25, "19.50 °C to 21.25 °C")],
)
def test_the_temperature_of_the_block_is_shown_where_it_was_measured(
    cal: Path, lowest_c: float | None, highest_c: float | None, shown: str | None
) -> None:
    own = made(cal, None)
    measured = {"temperature_min_c": lowest_c, "temperature_max_c": highest_c}
    saved = own.saved.model_copy(update={"conditions": own.saved.conditions.model_copy(update=measured)})
    assert dict(document.content(replace(own, saved=saved), "checked")["method"])["Temperature of the block"] == shown


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
    monkeypatch.setattr("kf_calib.errors.find_spec", lambda name: None)
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
        statement.read_statement(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_before_adjustment_is_shown_beside(cal: Path, lab: Path) -> None:
    lab.write_text(f"before = {json.dumps(str(cal))}\n{LAB}")
    own = made(cal, lab)
    for each in own.results:
        assert each.before == pytest.approx((each.value, each.expanded))
    assert len(document.content(own, "")["adjustment"]) == 12


@sets
def test_the_command_writes_both_files(run: Any, cal: Path, lab: Path, tmp_path: Path) -> None:
    pdf, xml = tmp_path / "c.pdf", tmp_path / "c.xml"
    printed = run.json("certificate", cal, "--statement", lab, "-o", pdf, "--xml", xml)
    assert printed["number"] == "1" and printed["not_stated"] == []
    assert [each["kind"] for each in printed["budget"]] == ["A", "B", "B", "B"]
    assert pdf.read_bytes().startswith(b"%PDF-") and ET.parse(io.BytesIO(xml.read_bytes()))
    earlier = tmp_path / "earlier.json"
    earlier.write_bytes(cal.read_bytes())
    lab.write_text(f'before = "earlier.json"\n{LAB}')  # counts from the statement
    for out in (lab, earlier):
        err = run.refused("certificate", cal, "-o", out, "--statement", lab, "--overwrite")
        assert "is read by this very command" in err


def test_the_xml_has_the_covariance_of_the_twelve_and_of_the_nine(cal: Path, lab: Path) -> None:
    own = made(cal, lab)
    root, names = ET.fromstring(dcc.xml(own)), {"dcc": dcc.DCC, "si": dcc.SI}
    vectors = root.findall(".//si:realListXMLList", names)
    assert [len(each.findtext("si:labelXMLList", "", names).split()) for each in vectors] == [12, 9]
    for vector, values, covariance in zip(
        vectors,
        [own.twelve[0], [each.value for each in own.intrinsic]],
        [own.budget.covariance, intrinsic(*own.twelve).covariance],
        strict=True,
    ):
        told = [float(text) for text in vector.findtext("si:valueXMLList", "", names).split()]
        np.testing.assert_array_equal(told, values)
        columns = vector.findall(".//si:covarianceXMLList", names)
        matrix = [[float(text) for text in each.findtext("si:valueXMLList", "", names).split()] for each in columns]
        np.testing.assert_array_equal(np.array(matrix).T, covariance)
        units = [each.findtext("si:unitXMLList", "", names).split() for each in columns]
        assert all(len(row) == len(told) for row in units) and units[0][0] != units[0][-1]
    assert [row["values"][k] for k, row in enumerate(document.content(own, "")["correlations"])] == ["1.000"] * 12
    assert len(document.content(own, "")["intrinsic"]) == 9


@sets
def test_a_monte_carlo_check_is_printed_and_in_the_json(run: Any, cal: Path, lab: Path, tmp_path: Path) -> None:
    words = ("certificate", cal, "--statement", lab, "-o", tmp_path / "c.pdf", "--monte-carlo", "20000")
    code, out, err = run(*words)
    assert code == 0 and "U by Monte Carlo" in out and "JCGM 101" in out + err
    told = run.json(*words, "--overwrite")
    assert told["monte_carlo"]["draws"] == 20000 and len(told["covariance"]) == 12
    assert [each["symbol"] for each in told["intrinsic"]][:4] == ["S1", "S2", "S3", "angle12"]
    standard = np.sqrt(np.diag(np.array(told["covariance"])))
    np.testing.assert_allclose(standard, [each["standard"] for each in told["parameters"]], rtol=1e-9)


def test_what_the_run_does_not_determine_has_no_number(cal: Path) -> None:
    saved = calibration_file.open_calibration(cal)
    first = saved.parameters[0].model_copy(update={"value": None, "sigma": None})
    own = saved.model_copy(update={"parameters": [first, *saved.parameters[1:]]})
    made = budget.certificate(
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
    "quantity": "name noQuantity real realListXMLList measurementMetaData",
    "metaData": "name conformity",
    "real": "label value unit measurementUncertaintyUnivariate",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability",
    "realListXMLList": "labelXMLList valueXMLList unitXMLList measurementUncertaintyMultivariateXMLList",
    "ellipsoidalRegionMUXMLList": "covarianceMatrixXMLList coverageFactorXMLList coverageProbabilityXMLList",
    "covarianceXMLList": "valueXMLList unitXMLList",
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
