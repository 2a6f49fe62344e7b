"""The command that writes a calibration certificate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.cli.command import INPUT, argument, command, option
from kf_calib.cli.echo import print_result
from kf_calib.cli.files import claimed, output_option
from kf_calib.cli.options import Json, Overwrite, ProgramOptions

if TYPE_CHECKING:
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.exchange.certificate.content import Certificate
    from kf_calib.exchange.certificate.statement import Statement
    from kf_calib.support.output_files import Outputs

StatementFile = Annotated[Path | None, option(
    "--statement", metavar="LAB.toml", panel=INPUT,
    help="What the laboratory states: docs/certificate.md has the keys.",
)]  # fmt: skip


@command("certificate cal.json --statement lab.toml -o certificate.pdf")
def certificate(
    calibration: Annotated[Path, argument(metavar="CAL")],
    output: Annotated[Path, output_option("-o", "--out", required=True, metavar="OUT.pdf",
                                          help="The certificate: PDF/A-3b with the XML attached.")],
    xml: Annotated[Path | None, output_option(
        "--xml", metavar="OUT.xml", help="Save the XML as a file of its own, too.")],
    statement: StatementFile,
    schema: Annotated[Path | None, option("--schema", metavar="DCC.xsd", panel=INPUT,
                                          help="Validate the XML against this copy of the DCC's schema.")],
    programs: ProgramOptions, overwrite: Overwrite, as_json: Json,
) -> None:  # fmt: skip
    """A calibration certificate as ISO/IEC 17025 asks: results, expanded uncertainties, budget, traceability.

    What is neither in the calibration nor in the statement is left blank. It never claims accreditation.
    """
    from kf_calib.exchange import calibration_file
    from kf_calib.exchange.certificate import statement as statements
    from kf_calib.views import certificate as views

    stated = statements.read_statement(statement)
    outputs = claimed([] if stated.before is None else [stated.before], overwrite=overwrite)
    calibrations = []
    for path in (calibration, stated.before):
        if path is not None:
            saved = calibration_file.open_calibration(path)
            calibrations.append((saved, saved.model(path, programs.effects_from, programs.trust)))
    written, standing = write_certificate(outputs, output, stated, *calibrations, xml=xml, schema=schema)
    print_result(as_json, views.certificate_object, views.certificate_report, written, standing, output, xml)


def stated_in(certificate: Path | None, statement: Path | None) -> Statement | None:
    """What a certificate states, checked before the work; None where there is to be none."""
    if certificate is None:
        if statement is not None:
            raise click.UsageError("--statement is for a certificate: name one with --certificate OUT.pdf.")
        return None
    from kf_calib.exchange.certificate import statement as statements
    from kf_calib.support.extras import need

    need("typst", "report", "a certificate")
    return statements.read_statement(statement)


def write_certificate(
    outputs: Outputs, pdf: Path, stated: Statement, calibrated: tuple[SavedCalibration, Model],
    before: tuple[SavedCalibration, Model] | None = None, xml: Path | None = None, schema: Path | None = None,
) -> tuple[Certificate, str]:  # fmt: skip
    """Write the certificate of a calibration with its model as ``out``; what it says, and what the check of its XML
    found. before: the same from before an adjustment.

    Raises InputError for a calibration, statement or schema that cannot be used, MissingExtraError without typst.
    """
    from kf_calib.exchange.certificate import content, dcc, document
    from kf_calib.support.output_files import write_whole

    certificate_ = content.certificate(*calibrated, stated, before)
    encoded = dcc.xml(certificate_)
    standing = dcc.check_dcc(encoded, schema)
    printed = document.pdf(certificate_, encoded, standing)
    outputs.write(pdf, lambda path: write_whole(path, printed))
    if xml is not None:
        outputs.write(xml, lambda path: write_whole(path, encoded))
    return certificate_, standing
