"""The parts of a calibration file, each a pydantic model: what its keys are, their types and limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from kf_calib.support.plain_text import CONTROLS, LONGEST

Text = Annotated[str, StringConstraints(max_length=LONGEST, pattern=rf"^[^{CONTROLS}]*$")]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Three = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Seconds = Annotated[float, Field(ge=-1e11, le=1e11, allow_inf_nan=False)]  # some thousand years
Warmth = Annotated[float, Field(ge=-273.15, le=1e4, allow_inf_nan=False)]
MOST_STATES, MOST_EFFECTS = 500, 100
"""Far more than a model can have that a bench could show; the time to check a file grows with their cubes."""
States = Field(max_length=MOST_STATES)
Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class Part(BaseModel):
    """What all parts have in common: exact types, no key that is not known."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SavedParameter(Part):
    """One of the twelve parameters, or a coefficient or constant of an effect; null where it was not determined."""

    symbol: Text
    value: Number | None
    sigma: Positive | None
    unit: Text
    nominal: Number


class SavedState(Part):
    """The state of the filter: affine, then the effects' coefficients; of a constant, ln(constant / its value).

    undetermined: symbols of the parameters and coefficients that the run did not determine.
    """

    symbols: Annotated[list[Text], States]
    values: Annotated[list[Number], States]
    covariance: Annotated[list[Annotated[list[Number], States]], States]
    undetermined: Annotated[list[Text], States]


class SavedProgram(Part):
    """A Python file that defines effects."""

    path: Text
    sha256: Sha256


class SavedEffect(Part):
    """An effect of the model: as ``--with`` takes it, with its constant where it has one."""

    text: Text
    constant: Number | None = None


class SavedNoise(Part):
    """The noise model, 1 sigma."""

    sigma_mps2: Three
    inflation: Three
    dwell_sigma_mps2: Three
    dwell_sigma_stated: bool
    angle_sigma_deg: Positive
    angle_sigma_stated: bool
    walk_mps2_per_sqrt_s: Positive


class SavedConsistency(Part):
    """Whether model and measurements agree; null where nothing was left over to judge by."""

    consistent: bool | None
    p_value: Share | None
    nis_per_dof: Positive | None
    dof: Count
    residual_rms_mps2: Positive
    held_out_rms_mps2: Positive | None
    held_out_floor_mps2: Positive | None


class SavedDwell(Part):
    """One orientation: gimbal angles (null: attitude recorded), begin, end, readings used."""

    gimbal_deg: list[Number] | None
    start_s: Seconds
    end_s: Seconds
    readings: Annotated[Count, Field(ge=1)]


class SavedConditions(Part):
    """Under which conditions it holds: when, how warm, which orientations. began: of the run; null if not known."""

    began: Text | None
    duration_s: Annotated[Seconds, Field(ge=0.0)]
    temperature_min_c: Warmth | None
    temperature_mean_c: Warmth | None
    temperature_max_c: Warmth | None
    dwells: list[SavedDwell]


class SavedProvenance(Part):
    """Where it comes from."""

    recording: Text
    sha256: Sha256 | None
    bench: dict[Text, Text]
    settings: dict[Text, Text]
    programs: list[SavedProgram]
    versions: dict[Text, Text]
    created: Text
    warnings: list[Text]
