"""A calibration as a file: everything that is needed to apply it, to defend it, and to repeat it.

    saved = calibration_file.open_calibration("cal.json")
    saved.correction()(readings_mps2, temperature_c)

JSON in SI units, of one version; ``calibration.schema.json`` beside this module is its JSON Schema. A file may name
effects whose classes are in a user's Python file: reading runs none, ``model`` runs those that it may.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from kf_calib import effects
from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.keys import checked_keys
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.bench.raw_input import RESTATE
from kf_calib.bench.streams import Source
from kf_calib.effects.user import Program
from kf_calib.errors import BenchError, InputError
from kf_calib.estimation import model_file
from kf_calib.estimation.correction import Correction
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.model_file import ModelFile
from kf_calib.estimation.observability import visibility_of
from kf_calib.estimation.results import Calibration
from kf_calib.exchange import calibration_parts as agreement
from kf_calib.exchange.calibration_parts import (
    MOST_EFFECTS,
    FilePart,
    SavedConditions,
    SavedConsistency,
    SavedDwell,
    SavedEffect,
    SavedNoise,
    SavedParameter,
    SavedProgram,
    SavedProvenance,
    SavedState,
    States,
    Text,
    first_misfit,
)
from kf_calib.sources.files.contents import CALIBRATION_FORMAT
from kf_calib.sources.files.record_files import fingerprint
from kf_calib.sources.opening import opened, run_date
from kf_calib.support.output_files import write_whole
from kf_calib.support.text import cut, format_date, sentence

VERSION = 1
_LARGEST_BYTES = 20_000_000


class SavedCalibration(FilePart):
    """The content of a calibration file.

    not_seen: effects of the catalogue that the orientations could not show, and which may thus be present. fixed:
    parameters that were not estimated because no angles were used, and what fixes each: the frame of the sensors, or
    axes that are taken for square.
    """

    format: Literal["kf_calib.calibration"]
    version: Literal[1]
    parameters: Annotated[list[SavedParameter], States]
    state: SavedState
    effects: Annotated[list[SavedEffect], Field(max_length=MOST_EFFECTS)]
    noise: SavedNoise
    consistency: SavedConsistency
    not_seen: list[Text]
    conditions: SavedConditions
    provenance: SavedProvenance
    fixed: dict[Text, Literal["frame", "square"]] = Field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<SavedCalibration: {self.summary}>"

    __str__ = __repr__

    @property
    def summary(self) -> str:
        """Of which recording it is, of when, and with which effects, in words."""
        effects = ", ".join(effect.text for effect in self.effects) or "no effects"
        day = (self.conditions.began or self.provenance.created)[:10]
        return f"of {self.provenance.recording} of {day}, twelve parameters and {effects}"

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> SavedCalibration:
        with np.errstate(all="ignore"):  # absurd numbers are refused, whatever they give
            agreement.refuse_state(self.state, self.fixed)
            agreement.refuse_effects(self.effects, self.state)
            agreement.refuse_parameters(self.parameters, self.state, self.fixed, self.bench)
            agreement.refuse_dependent_axes(self.state)
            agreement.refuse_judgement(self.consistency)
            agreement.refuse_conditions(self.conditions, self.provenance, self.bench)
        return self

    @property
    def bench(self) -> Bench:
        """The bench of the run."""
        bench = Bench.from_metadata(dict(self.provenance.bench), "axes" in self.provenance.bench)
        return replace(bench, angles=False) if self.fixed else bench

    @property
    def square(self) -> tuple[str, ...]:
        """The angles by which axes were taken for square."""
        return tuple(angle for angle, by in self.fixed.items() if by == "square")

    @property
    def twelve(self) -> tuple[Floats, Floats]:
        """The twelve parameters (12,) and their covariance (12, 12)."""
        state = np.array(self.state.values[:STATE_COUNT])
        jacobian = paper_parameters.jacobian(state)
        covariance = np.array(self.state.covariance)[:STATE_COUNT, :STATE_COUNT]
        return paper_parameters.parameters_of(state), jacobian @ covariance @ jacobian.T

    def model_file(self, origin: Path | None = None) -> ModelFile:
        """Its effects as a model file at ``origin`` has them."""
        origin = origin or Path(CALIBRATION_FORMAT)
        programs = tuple(Program(origin.parent / each.path, each.sha256) for each in self.provenance.programs)
        return ModelFile(origin, tuple(each.text for each in self.effects), programs)

    def model(
        self, origin: Path | None = None, named: Sequence[str | Path] = (), trust: bool = False,
        bench: Bench | None = None,
    ) -> Model:  # fmt: skip
        """The fitted model, with the constants of its effects.

        origin: where the file lies, from which paths of programs count. named, trust: Python files that may be run, as
        of a model file. bench: another one to use it on. Raises InputError if a program may not be run, or an effect is
        not known.
        """
        origin, bench = origin or Path(CALIBRATION_FORMAT), bench or self.bench
        self.model_file(origin).load(named, trust)
        model = Model(bench, square=self.square)
        for own in self.effects:
            effect = effects.effect_named(own.text, bench)
            model += _at_constant(effect, own.constant, origin, self.state.symbols)
        try:
            agreement.refuse_coefficients(self.parameters, self.state, self.noise, model)
        except ValueError as error:
            raise InputError(f"{origin}: {error}: give a calibration as --save has written it.") from None
        return model

    def correction(
        self, origin: Path | None = None, named: Sequence[str | Path] = (), trust: bool = False
    ) -> Correction:
        """What turns readings into specific force by this calibration; arguments as for ``model``."""
        return Correction(
            self.bench, self.model(origin, named, trust), np.array(self.state.values),
            np.array(self.state.covariance), np.array(self.noise.sigma_mps2), tuple(self.state.undetermined),
        )  # fmt: skip


def _at_constant(
    effect: effects.Effect, constant: float | None, origin: Path, symbols: Collection[str]
) -> effects.Effect:
    """The effect with its constant, which a file states for effects that have one, and within their range; what is not
    among the ``symbols`` of the state was held, or is zero by convention."""
    if isinstance(effect, effects.RotationEffect):
        effect = effect.without({each.symbol for each in effect.coefficients}.difference(symbols))
    if constant is None and effect.unknown is None:
        return effect
    if constant is None or effect.unknown is None or effect.at(constant).value != constant:
        known = effect.unknown
        can = f"from {known.low:g} to {known.high:g} {known.unit}" if known else "none at all"
        raise InputError(f"{origin}: {effect} has the constant {constant}, and can have {can}: give a calibration as "
                         "--save has written it.")  # fmt: skip
    at_constant = effect.at(constant)
    at_constant.held = effect.unknown.symbol not in symbols
    return at_constant


def saved(
    result: Calibration, recording: str = "", sha256: str | None = None, began: datetime | None = None
) -> SavedCalibration:
    """A calibration as it is saved; recording: its name. sha256: of its file. began: when its run did, if known.

    Raises InputError where a calibration cannot be saved.
    """
    try:
        return _saved(result, recording, sha256, began)
    except ValidationError as error:
        raise InputError(f"this calibration cannot be saved, as {_said(error)}.") from None


def _saved(result: Calibration, recording: str, sha256: str | None, began: datetime | None) -> SavedCalibration:
    """The calibration as its parts say it."""
    estimate, noise, judged = result.estimate, result.noise, result.consistency
    return SavedCalibration(
        format=CALIBRATION_FORMAT,
        version=VERSION,
        parameters=[SavedParameter(symbol=p.symbol, value=p.value, sigma=p.sigma, unit=p.unit, nominal=p.nominal)
                    for p in result.parameters.values()],
        state=SavedState(
            symbols=[*paper_parameters.STATES, *(c.symbol for c in result.model.coefficients)],
            values=estimate.state.tolist(),
            covariance=estimate.covariance.tolist(),
            undetermined=list(result.undetermined),
        ),
        effects=[SavedEffect(text=effects.as_text(each), constant=each.value if each.unknown else None)
                 for each in result.model.effects],
        noise=SavedNoise(
            sigma_mps2=noise.sigma_mps2.tolist(), inflation=noise.inflation.tolist(),
            dwell_sigma_mps2=noise.scatter_mps2.tolist(), dwell_sigma_stated=noise.scatter.stated,
            angle_sigma_deg=0.0 if noise.attitude_unknown else math.degrees(noise.setting_rad),
            angle_sigma_stated=noise.setting.stated and not noise.attitude_unknown,
            walk_mps2_per_sqrt_s=noise.walk.rms_mps2_per_sqrt_s,
            walk_of_each_mps2_per_sqrt_s=noise.walk_mps2_per_sqrt_s.tolist(),
        ),
        consistency=SavedConsistency(
            consistent=judged.consistent, p_value=judged.p_value, nis_per_dof=judged.nis_per_dof, dof=judged.dof,
            residual_rms_mps2=result.residual_rms_mps2, held_out_rms_mps2=result.held_out_rms_mps2,
            held_out_floor_mps2=result.held_out_floor_mps2,
        ),
        not_seen=_not_seen(result),
        conditions=_conditions(result, began),
        provenance=_provenance(result, recording, sha256),
        fixed=result.fixed,
    )  # fmt: skip


def of_source(result: Calibration, source: Source) -> SavedCalibration:
    """The calibration of a source, with the date of its run, and of a recording with its name and checksum."""
    path = getattr(source, "path", None)
    name, checksum = ("", None) if path is None else (path.name, fingerprint(path))
    return saved(result, name, checksum, run_date(source))


def save_calibration(
    result: Calibration, path: str | Path, source: Source | str | os.PathLike[str] | None = None
) -> None:
    """Save a calibration, for ``open_calibration`` and the commands apply, verify and history.

    source: the recording, log or table that it was made from, or its path; its name, checksum and date are saved, too.
    Raises InputError if the file cannot be written.
    """
    if source is not None:
        source = opened(source, checked_keys(result.bench.to_metadata() | {RESTATE: "true"}), angles=False)
    write_calibration(Path(path), saved(result) if source is None else of_source(result, source))


def _not_seen(result: Calibration) -> list[str]:
    """Return the names of effects of the catalogue that the orientations cannot show."""
    every = [effects.effect_named(name, result.bench) for name in effects.names(result.bench)]
    others = [each for each in every if str(each) not in result.model.parts and not each.walks]
    seen = visibility_of(result.fit, others)
    return [str(each.effect) for each in seen if not each.visible]


def _conditions(result: Calibration, began: datetime | None) -> SavedConditions:
    """Return when and how the run was made."""
    dwells = result.fit.dwells
    warmth = dwells.folded.pieces.nodes.temperature_c
    known = bool(np.isfinite(warmth).any())
    return SavedConditions(
        began=None if began is None else format_date(began),
        duration_s=dwells[-1].end_s,
        temperature_min_c=float(np.nanmin(warmth)) if known else None,
        temperature_mean_c=float(np.nanmean(warmth)) if known else None,
        temperature_max_c=float(np.nanmax(warmth)) if known else None,
        dwells=[SavedDwell(gimbal_deg=np.degrees(dwell.recorded_pose).tolist() if result.bench.axes else None,
                           start_s=dwell.start_s, end_s=dwell.end_s, readings=dwell.count) for dwell in dwells],
    )  # fmt: skip


def _provenance(result: Calibration, recording: str, sha256: str | None) -> SavedProvenance:
    """Return where a result comes from."""
    settings = result.settings
    return SavedProvenance(
        recording=sentence(recording),
        sha256=sha256,
        bench={key: sentence(text) for key, text in result.bench.to_metadata().items()},
        settings={
            "engine": settings.engine, "gate_sigma": str(settings.gate_sigma), "prior": str(settings.prior),
            "walk_mps2_per_sqrt_s": str(settings.walk_mps2_per_sqrt_s), "stillness": str(settings.stillness),
            "left_out": " ".join(map(str, settings.left_out)),
            **({"bench_model": sentence(str(settings.bench_model))} if settings.bench_model else {}),
        },
        programs=[SavedProgram(path=str(each.path), sha256=each.sha256)
                  for each in effects.programs_of(result.model.effects)],
        versions={"kf_calib": version("kf_calib"), "numpy": np.__version__, "python": platform.python_version()},
        created=now(),
        warnings=list(map(sentence, result.warnings)),
    )  # fmt: skip


def now() -> str:
    """The present in UTC; what SOURCE_DATE_EPOCH says where that is set, so that files can be made again."""
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(stated), UTC) if re.fullmatch(r"\d{1,11}", stated) else datetime.now(UTC)
    return moment.isoformat(timespec="seconds")


def write_calibration(path: Path, content: SavedCalibration) -> None:
    """Write a calibration file, wholly or not at all; raises InputError if it cannot be written."""
    table = content.model_dump(mode="json", exclude=None if content.fixed else {"fixed"})
    write_whole(path, (json.dumps(table, indent=1, allow_nan=False) + "\n").encode())


def open_calibration(path: str | Path) -> SavedCalibration:
    """Read a calibration file and check all of it; raises InputError, with the path and the place in it."""
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path}: is larger than any calibration: give a file that --save has written.")
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): give a file that --save has written.") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is no JSON: give a calibration that --save has written.") from None
    if not isinstance(content, dict) or content.get("format") != CALIBRATION_FORMAT:
        raise InputError(
            f"{path}: is no calibration (its format is not {CALIBRATION_FORMAT}): give one that --save has written."
        )
    if content.get("version") != VERSION:
        said = cut(repr(content.get("version")), 20)
        raise InputError(f"{path}: is of version {said}, this program reads version {VERSION}: update kf_calib.")
    return _checked(path, content)


def _checked(path: Path, content: dict[str, Any]) -> SavedCalibration:
    """Return the content if all of it is as it must be; raise InputError if not."""
    try:
        saved = SavedCalibration.model_validate(content)
        saved.bench  # noqa: B018  # raises BenchError
    except ValidationError as error:
        raise InputError(f"{path}: {_said(error)}: give a calibration as --save has written it.") from None
    except BenchError as error:
        raise InputError(f"{path}: provenance.bench: {error}") from None
    return saved


def _said(error: ValidationError) -> str:
    """The first thing that does not fit, and where."""
    place, said, kind = first_misfit(error)
    if kind == "string_pattern_mismatch" and not place.endswith("sha256"):
        said = "it must be text on one line, without control characters"
    return f"{place}: {said}" if place else said


def schema() -> dict[str, Any]:
    """The JSON Schema of calibration files, as ``calibration.schema.json`` has it."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | SavedCalibration.model_json_schema()


def read_model(path: str | Path) -> ModelFile:
    """Read the model of a file of either kind, told by its first character; no Python file that it names is run.

    Raises InputError, with the path, if the file cannot be read or used.
    """
    path = Path(path)
    return open_calibration(path).model_file(path) if _is_json(path) else model_file.read_model_file(path)


def _is_json(path: Path) -> bool:
    """Whether a file begins as a JSON object, which no TOML does; one that cannot be read is for others to refuse."""
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip().startswith(b"{")
    except (OSError, ValueError):
        return False
