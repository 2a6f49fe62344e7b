"""The rows of a recording sample by sample, from a second pass, for filterpy and for batch least squares."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.dwells.rows import Rows, basis, on_basis
from kf_calib.dwells.stack import Folded
from kf_calib.estimation.dwell_columns import LinearisedDwells, has_turns, turning_mps2
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.nuisance_states import (
    along_force,
    flicker_sigmas,
    flicker_waves,
    nuisance_map,
    nuisance_sigmas,
    sensitivities_of,
)


def all_nuisance_sigmas(noise: Noise) -> Floats:
    """Prior sigmas (q,) of the nuisance states of a dwell, those of the slow waves of 1/f noise last."""
    sigmas = nuisance_sigmas(noise)
    return sigmas if noise.flicker_mps2 is None else np.append(sigmas, flicker_sigmas(noise.flicker_mps2))


@dataclass(frozen=True)
class Samples:
    """Rows of one piece, sample by sample.

    - dwell: number of the dwell; moving: True for the slew after it.
    - elapsed_s (n,): times of the samples.
    - observation (n, c, p): the design H of the c channels: three accelerometers, or the size of the force alone where
      attitudes are not known.
    - nuisances (n, c, q): the columns of the dwell's nuisance states.
    - nuisance_sigmas (q,): the prior sigmas of these.
    - readings (n, c): the readings.
    - residual_mps2 (n, 3): the readings of the accelerometers less their prediction by the state of the linearisation.
    - sigma_mps2 (c,): sigma of white readings with the same variance of their mean.
    """

    dwell: int
    elapsed_s: Floats
    observation: Floats
    nuisances: Floats
    nuisance_sigmas: Floats
    readings: Floats
    residual_mps2: Floats
    sigma_mps2: Floats
    moving: bool = False

    def along(self, weights: Floats) -> Samples:
        """The samples of one combination of the three channels, with weights (3,)."""
        return replace(
            self,
            observation=np.einsum("i,nip->np", weights, self.observation)[:, None],
            nuisances=np.einsum("i,niq->nq", weights, self.nuisances)[:, None],
            readings=(self.readings @ weights)[:, None],
            sigma_mps2=np.array([np.linalg.norm(weights * self.sigma_mps2)]),
        )


def samples_of(rows: Iterable[Rows], linearised: LinearisedDwells, noise: Noise) -> Iterator[Samples]:
    """Yield samples from a second pass over the rows, with the columns of the first."""
    every, columns = [*linearised.dwells_at_state, *linearised.slews], [*linearised.columns, *linearised.slew_columns]
    known = {
        (dwell.number, dwell.moving): (dwell, iter(zip(at_nodes, flicker_waves(Folded([dwell])), strict=True)))
        for dwell, at_nodes in zip(every, columns, strict=True)
    }
    sigmas = all_nuisance_sigmas(noise)
    for block in rows:
        if (block.dwell, block.moving) not in known:
            continue
        dwell, pieces = known[block.dwell, block.moving]
        sensitivities = sensitivities_of([dwell], linearised.state)
        along = along_force([dwell], sensitivities)[0] if noise.attitude_unknown else None
        regressor_map = nuisance_map(sensitivities, noise)[0]
        for part, u, _ in block.pieces:
            at_nodes, waves = next(pieces)
            functions = basis(u, block.elapsed_s[part], linearised.carrier_hz)
            observation = (functions.T @ on_basis(at_nodes.reshape(len(at_nodes), -1))).reshape(
                len(u), *at_nodes.shape[1:]
            )
            regressors, readings = block.columns[part], block.readings[part]
            if not linearised.model.bench.angles:
                regressors = np.tile(dwell.means[:4], (len(u), 1))
            if dwell.attitude is not None or dwell.turned_rad is not None:
                force = dwell.felt_force(regressors[:, 1:])
                regressors = np.hstack([regressors[:, :1], force])
                if has_turns(dwell):
                    readings = readings + turning_mps2(dwell, force, linearised.state)
            nuisances = np.einsum("nc,icq->niq", regressors, regressor_map)
            if noise.flicker_mps2 is not None:
                course = functions[:3].T @ on_basis(waves)
                slow = np.eye(3)[None, :, :, None] * course[:, None, None, :]  # those of each accelerometer its own
                nuisances = np.concatenate([nuisances, slow.reshape(len(u), 3, -1)], axis=2)
            sigma_mps2 = noise.of(block.moving).effective_sigma_mps2 / math.sqrt(dwell.weight)
            residual_mps2 = readings - observation @ linearised.state
            samples = Samples(
                block.dwell, block.elapsed_s[part], observation, nuisances, sigmas, readings, residual_mps2,
                sigma_mps2, block.moving,
            )  # fmt: skip
            yield samples.along(along) if along is not None else samples
