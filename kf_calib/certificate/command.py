"""The command that writes a calibration certificate, and what ``report --certificate`` takes of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich_click as click

from kf_calib.cli.command import INPUT, OUTPUT, command, option
from kf_calib.cli.echo import print_result
from kf_calib.cli.files import claimed, output_option
from kf_calib.cli.options import CalibrationFile, Json, Overwrite, ProgramOptions, StatementFile
from kf_calib.errors import need

if TYPE_CHECKING:
    from kf_calib.certificate.budget import Certificate
    from kf_calib.certificate.statement import Statement
    from kf_calib.estimation.measurement_model import Model
    from kf_calib.exchange.calibration_file import SavedCalibration
    from kf_calib.support.output_files import Outputs


@command("certificate cal.json --statement lab.toml -o certificate.pdf")
def certificate(
    calibration: CalibrationFile,
    output: Annotated[Path, output_option("-o", "--out", required=True, metavar="OUT.pdf",
                                          help="The certificate: PDF/A-3b with the XML attached.")],
    xml: Annotated[Path | None, output_option(
        "--xml", metavar="OUT.xml", help="Save the XML as a file of its own, too.")],
    statement: StatementFile,
    schema: Annotated[Path | None, option("--schema", metavar="DCC.xsd", panel=INPUT,
                                          help="Validate the XML against this copy of the DCC's schema.")],
    draws: Annotated[int | None, option(
        "--monte-carlo", metavar="DRAWS", type=click.IntRange(min=10_000, max=10_000_000), panel=OUTPUT,
        help="Check the expanded uncertainties by so many draws, 1000000 for example (JCGM 101).")],
    programs: ProgramOptions, overwrite: Overwrite, as_json: Json,
) -> None:  # fmt: skip
    """A calibration certificate as ISO/IEC 17025 asks: results, expanded uncertainties, budget, traceability.

    What is neither in the calibration nor in the statement is left blank. It never claims accreditation.
    """
    from kf_calib.certificate import statement as statements
    from kf_calib.certificate import text as views
    from kf_calib.certificate.monte_carlo import monte_carlo
    from kf_calib.exchange import calibration_file

    stated = statements.read_statement(statement)
    outputs = claimed([] if stated.before is None else [stated.before], overwrite=overwrite)
    calibrations = []
    for path in (calibration, stated.before):
        if path is not None:
            saved = calibration_file.open_calibration(path)
            calibrations.append((saved, saved.model(path, programs.effects_from, programs.trust)))
    written, standing = write_certificate(outputs, output, stated, *calibrations, xml=xml, schema=schema)
    check = None if draws is None else monte_carlo(written.budget, draws)
    print_result(as_json, views.certificate_object, views.certificate_report, written, standing, check, output, xml)


def stated_in(certificate: Path | None, statement: Path | None) -> Statement:
    """What the certificate of a report states, checked before the work."""
    if certificate is None:
        raise click.UsageError("--statement is for a certificate: name one with --certificate OUT.pdf.")
    from kf_calib.certificate import statement as statements

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
    from kf_calib.certificate import budget, dcc, document
    from kf_calib.support.output_files import write_whole

    certificate_ = budget.certificate(*calibrated, stated, before)
    encoded = dcc.xml(certificate_)
    standing = dcc.check_dcc(encoded, schema)
    printed = document.pdf(certificate_, encoded, standing)
    outputs.write(pdf, lambda path: write_whole(path, printed))
    if xml is not None:
        outputs.write(xml, lambda path: write_whole(path, encoded))
    return certificate_, standing
