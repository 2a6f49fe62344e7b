"""The certificate as XML: a Digital Calibration Certificate (DCC 3.3.0) with quantities in D-SI 2.2.1.

Elements come in the order of the schema. What is not stated is left out; where that is mandatory, the file says in a
comment that it is no DCC. The schema (LGPL) is not part of this program: ``check_dcc`` validates against a copy where
it is given one, and else looks for the mandatory elements.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.certificate.budget import COVERAGE, Certificate, CertifiedResult, ellipsoid_factor
from kf_calib.certificate.intrinsic import SYMBOLS, intrinsic
from kf_calib.certificate.intrinsic import UNITS as INTRINSIC_UNITS
from kf_calib.certificate.statement import Party
from kf_calib.errors import InputError, need
from kf_calib.support.text import cut

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
VERSION, SCHEMA = "3.3.0", f"{DCC}/v3.3.0/dcc.xsd"
UNITS = {"rad": r"\radian", "1": r"\one", "m/s^2": r"\metre\second\tothe{-2}"}
SQUARES = {"rad": r"\radian\tothe{2}", "1": r"\one", "m/s^2": r"\metre\tothe{2}\second\tothe{-4}"}
"""Units of the twelve parameters, and of their variances, as D-SI writes them."""

MODEL = "reading_i = K_i E_i . f + b_i"
AXES = ("E_1, E_3 = (cos phi cos theta, sin theta, -sin phi cos theta)",
        "E_2 = (sin nu1, sqrt(1 - sin^2 nu1 - sin^2 nu2), -sin nu2)")  # fmt: skip
METHOD = "Weighted least squares by a sequential Kalman filter over the orientations of a stationary gimballed bench"
_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_MANDATORY = (
    "administrativeData/dccSoftware/software", "administrativeData/coreData/countryCodeISO3166_1",
    "administrativeData/coreData/uniqueIdentifier", "administrativeData/coreData/beginPerformanceDate",
    "administrativeData/coreData/endPerformanceDate", "administrativeData/coreData/performanceLocation",
    "administrativeData/items/item/name", "administrativeData/items/item/identifications/identification/value",
    "administrativeData/calibrationLaboratory/contact/name",
    "administrativeData/calibrationLaboratory/contact/location",
    "administrativeData/respPersons/respPerson/person/name", "administrativeData/customer/name",
    "administrativeData/customer/location", "measurementResults/measurementResult/results/result/data",
)  # fmt: skip


def xml(certificate: Certificate) -> bytes:
    """The XML of a certificate."""
    ET.register_namespace("dcc", DCC)
    ET.register_namespace("si", SI)
    ET.register_namespace("xsi", "http://www.w3.org/2001/XMLSchema-instance")
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", {
        "schemaVersion": VERSION, "{http://www.w3.org/2001/XMLSchema-instance}schemaLocation": f"{DCC} {SCHEMA}",
    })  # fmt: skip
    if certificate.missing:
        root.append(ET.Comment(f" not a DCC: not stated are {', '.join(certificate.missing)} "))
    data = _in(root, "administrativeData")
    _software(_in(data, "dccSoftware"))
    _core(_in(data, "coreData"), certificate)
    _item(_in(_in(data, "items"), "item"), certificate)
    _contact(_in(_in(data, "calibrationLaboratory"), "contact"), certificate.statement.laboratory)
    _persons(data, certificate)
    _contact(_in(data, "customer"), certificate.statement.customer)
    _statements(data, certificate)
    _measurement(_in(_in(root, "measurementResults"), "measurementResult"), certificate)
    ET.indent(root, " ")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="utf-8") + b"\n"


def _in(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    """A new element at the end of its parent; a name of D-SI begins with ``si:``."""
    space = SI if name.startswith("si:") else DCC
    own = ET.SubElement(parent, f"{{{space}}}{name.removeprefix('si:')}")
    own.text = text if text is None else _NOT_XML.sub("\ufffd", text)
    return own


def _given(parent: ET.Element, name: str, text: str | date | None) -> None:
    """An element, if there is something to put into it."""
    if text is not None:
        _in(parent, name, " ".join(str(text).split()))


def _words(parent: ET.Element, name: str, *texts: str | None) -> None:
    """An element of text in English, if there is any."""
    known = [text for text in texts if text]
    if known:
        own = _in(parent, name)
        for text in known:
            _in(own, "content", text).set("lang", "en")


def _software(parent: ET.Element) -> None:
    software = _in(parent, "software")
    _words(software, "name", "kf_calib")
    _in(software, "release", version("kf_calib"))
    _in(software, "type", "application")


def _core(parent: ET.Element, certificate: Certificate) -> None:
    stated = certificate.statement
    _given(parent, "countryCodeISO3166_1", stated.laboratory.country)
    _in(parent, "usedLangCodeISO639_1", "en")
    _in(parent, "mandatoryLangCodeISO639_1", "en")
    _given(parent, "uniqueIdentifier", stated.number)
    _given(parent, "receiptDate", stated.received)
    _given(parent, "beginPerformanceDate", certificate.begun)
    _given(parent, "endPerformanceDate", certificate.ended)
    _given(parent, "performanceLocation", stated.site)
    _given(parent, "issueDate", stated.issued)


def _item(parent: ET.Element, certificate: Certificate) -> None:
    item = certificate.statement.item
    _words(parent, "name", item.name)
    _words(parent, "description", item.state)
    if item.manufacturer:
        _words(_in(parent, "manufacturer"), "name", item.manufacturer)
    _given(parent, "model", item.model)
    if certificate.serial:
        identified = _in(_in(parent, "identifications"), "identification")
        _in(identified, "issuer", "manufacturer")
        _given(identified, "value", certificate.serial)
        _words(identified, "name", "serial number")


def _contact(parent: ET.Element, party: Party) -> None:
    _words(parent, "name", party.name)
    _given(parent, "eMail", party.email)
    _given(parent, "phone", party.phone)
    place = {"city": party.city, "countryCode": party.country, "postCode": party.postcode, "street": party.street}
    if any(place.values()):
        location = _in(parent, "location")
        for name, text in place.items():
            _given(location, name, text)


def _persons(parent: ET.Element, certificate: Certificate) -> None:
    listed = _in(parent, "respPersons")
    for k, person in enumerate(certificate.statement.persons):
        responsible = _in(listed, "respPerson")
        _words(_in(responsible, "person"), "name", person.name)
        _given(responsible, "role", person.role)
        _in(responsible, "mainSigner", "true" if k == 0 else "false")


def _statements(parent: ET.Element, certificate: Certificate) -> None:
    stated = {"traceability": certificate.statement.traceability, "remarks": certificate.statement.remarks}
    if certificate.statement.decision_rule:
        stated["decision rule"] = rule(certificate)
    if any(stated.values()):
        listed = _in(parent, "statements")
        for name, text in stated.items():
            if text:
                element = _in(listed, "statement")
                _words(element, "name", name)
                _words(element, "declaration", text)


def rule(certificate: Certificate) -> str:
    """The rule by which conformity is decided, in words."""
    if certificate.statement.decision_rule == "guard band":
        return ("Guard band of the width of the expanded uncertainty U: pass where the deviation from nominal is at "
                "most the limit less U, fail where it is more than the limit plus U; between them, conditional pass "
                "within the limit and conditional fail beyond it (ILAC-G8).")  # fmt: skip
    return "Simple acceptance: pass where the deviation from nominal is at most the limit, whatever its uncertainty."


def _measurement(parent: ET.Element, certificate: Certificate) -> None:
    stated = certificate.statement
    _words(parent, "name", "Calibration of three accelerometers")
    method = _in(_in(parent, "usedMethods"), "usedMethod")
    _words(method, "name", "Multi-position calibration on a gimballed bench")
    _words(method, "description", stated.method or METHOD, MODEL, *AXES)
    for norm in stated.norms:
        _given(method, "norm", norm)
    _software(_in(parent, "usedSoftware"))
    _conditions(_in(parent, "influenceConditions"), certificate)
    results = _in(parent, "results")
    data = _result(results, "Parameters of the accelerometers")
    for each in certificate.results:
        _quantity(data, each)
    twelve = certificate.twelve
    if twelve is not None:
        _multivariate(data, "all parameters with their covariance", paper_parameters.SYMBOLS, paper_parameters.UNITS,
                      *twelve, float(certificate.budget.dof.min()))  # fmt: skip
        nine = intrinsic(*twelve)
        own_data = _result(results, "Intrinsic parameters, which no choice of a frame changes: sensitivities, angles "
                           "between the input axes, offsets")  # fmt: skip
        _multivariate(own_data, "all intrinsic parameters with their covariance", SYMBOLS, INTRINSIC_UNITS,
                      nine.values, nine.covariance, float(certificate.budget.dof.min()))  # fmt: skip


def _result(parent: ET.Element, name: str) -> ET.Element:
    result = _in(parent, "result")
    _words(result, "name", name)
    return _in(result, "data")


def _multivariate(
    parent: ET.Element, name: str, symbols: Sequence[str], units: Sequence[str], values: Floats, covariance: Floats,
    dof: float,
) -> None:  # fmt: skip
    """A vector of quantities with its covariance matrix and the ellipsoid that holds it with ``COVERAGE``; dof: degrees
    of freedom of the covariance."""
    element = _in(parent, "quantity")
    _words(element, "name", name)
    listed = _in(element, "si:realListXMLList")
    _in(listed, "si:labelXMLList", " ".join(symbols))
    _in(listed, "si:valueXMLList", " ".join(map(repr, values.tolist())))
    _in(listed, "si:unitXMLList", " ".join(UNITS[unit] for unit in units))
    region = _in(_in(listed, "si:measurementUncertaintyMultivariateXMLList"), "si:ellipsoidalRegionMUXMLList")
    matrix = _in(region, "si:covarianceMatrixXMLList")
    for unit, column in zip(units, covariance.T.tolist(), strict=True):
        own = _in(_in(matrix, "si:columnXMLList"), "si:covarianceXMLList")
        _in(own, "si:valueXMLList", " ".join(map(repr, column)))
        _in(own, "si:unitXMLList", " ".join(_product(unit, other) for other in units))
    _in(region, "si:coverageFactorXMLList", repr(ellipsoid_factor(len(values), dof)))
    _in(region, "si:coverageProbabilityXMLList", f"{COVERAGE:.4f}")


def _product(one: str, other: str) -> str:
    """The unit of a covariance."""
    if one == other:
        return SQUARES[one]
    return "".join(UNITS[unit] for unit in (one, other) if unit != "1")


def _conditions(parent: ET.Element, certificate: Certificate) -> None:
    """Gravity, temperature of the block and what the laboratory says of its surroundings."""
    saved, stated = certificate.saved, certificate.statement.conditions
    own_data = _condition(parent, "Local acceleration of free fall")
    _real(_in(own_data, "quantity"), None, saved.bench.gravity_mps2, UNITS["m/s^2"])
    for name in ("min", "mean", "max"):
        value = getattr(saved.conditions, f"temperature_{name}_c")
        if value is not None:
            data = _condition(parent, f"Temperature of the accelerometers, {name}")
            _real(_in(data, "quantity"), None, value, r"\degreecelsius")
    for name in ("temperature", "humidity", "pressure", "note"):
        if text := getattr(stated, name):
            _words(_condition(parent, f"Surroundings: {name}"), "text", text)


def _condition(parent: ET.Element, name: str) -> ET.Element:
    own = _in(parent, "influenceCondition")
    _words(own, "name", name)
    return _in(own, "data")


def _quantity(parent: ET.Element, result: CertifiedResult) -> None:
    """One parameter, with its expanded uncertainty."""
    element = _in(parent, "quantity")
    _words(element, "name", result.symbol)
    if result.value is None or result.expanded is None:
        _words(element, "noQuantity", "not determined by this run")
        return
    real = _real(element, result.symbol, result.value, UNITS[result.unit])
    spread = _in(_in(real, "si:measurementUncertaintyUnivariate"), "si:expandedMU")
    _in(spread, "si:valueExpandedMU", repr(result.expanded))
    _in(spread, "si:coverageFactor", repr(result.k))
    _in(spread, "si:coverageProbability", f"{COVERAGE:.4f}")
    if result.conformity is not None:
        judged = _in(_in(element, "measurementMetaData"), "metaData")
        _words(judged, "name", "conformity of the deviation from nominal")
        _in(judged, "conformity", result.conformity)


def _real(parent: ET.Element, label: str | None, value: float, unit: str) -> ET.Element:
    element = _in(parent, "si:real")
    if label is not None:
        _in(element, "si:label", label)
    _in(element, "si:value", repr(value))
    _in(element, "si:unit", unit)
    return element


def check_dcc(content: bytes, schema: Path | None) -> str:
    """Check the XML and return which check that was, in words; raises InputError with the first thing that is wrong.

    schema: a copy of ``dcc.xsd`` with what it imports beside it; nothing is fetched.
    """
    root = ET.fromstring(content)
    missing = [each for each in _MANDATORY if root.find(f"{{{DCC}}}" + each.replace("/", f"/{{{DCC}}}")) is None]
    if missing:
        return f"not a DCC: {len(missing)} mandatory elements are not stated"
    if schema is None:
        return f"all mandatory elements of DCC {VERSION} are there; not validated against its schema (--schema dcc.xsd)"
    _validate(content, schema)
    return f"valid by {schema.name}"


def _validate(content: bytes, schema: Path) -> None:
    need("xmlschema", "report", "a check against a schema")
    import xmlschema

    try:
        checker = xmlschema.XMLSchema(str(schema), allow="local")
    except (OSError, xmlschema.XMLSchemaException, ET.ParseError) as error:
        said = cut(" ".join(str(error).split()), 200)
        raise InputError(f"{schema}: cannot be read as an XML Schema ({said}): give dcc.xsd of DCC {VERSION}, with "
                         "the schemas that it imports where it says.") from None  # fmt: skip
    error = next(checker.iter_errors(ET.fromstring(content)), None)
    if error is not None:
        reason = cut(" ".join((error.reason or "").split()), 300)
        raise InputError(f"{schema}: the certificate is not valid by it at {error.path} ({reason}): is it of DCC "
                         f"{VERSION}?")  # fmt: skip
