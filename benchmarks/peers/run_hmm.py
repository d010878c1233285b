"""A hidden Markov model of four gait phases, in the peers' environment: trained with the judged person left out.

    python benchmarks/peers/run_hmm.py IN.npz OUT.npz

IN: ``persons`` (T,), and of each trial k ``x_k`` (N, 2) features and ``y_k`` (N,) labels 0 to 3. OUT: ``y_k`` decoded.
As Sánchez Manchola et al. (2019): one Gaussian state a phase, of the sagittal rate and its derivative, from the labels.
"""

from __future__ import annotations

import sys

import numpy as np
from hmmlearn.hmm import GaussianHMM

STATES = 4


def trained(trials: list[tuple[np.ndarray, np.ndarray]]) -> GaussianHMM:
    """The model that the labels of these trials say."""
    x, y = (np.concatenate(parts) for parts in zip(*trials, strict=True))
    counts = np.full((STATES, STATES), 1e-9)
    for _, labels in trials:
        np.add.at(counts, (labels[:-1], labels[1:]), 1.0)
    model = GaussianHMM(STATES, covariance_type="full", init_params="", params="")
    model.startprob_ = np.bincount(y, minlength=STATES) / len(y)
    model.transmat_ = counts / counts.sum(axis=1, keepdims=True)
    model.means_ = np.stack([x[y == k].mean(axis=0) for k in range(STATES)])
    model.covars_ = np.stack([np.cov(x[y == k].T) for k in range(STATES)])
    return model


def main() -> None:
    data = np.load(sys.argv[1])
    persons = data["persons"]
    trials = [(data[f"x_{k}"], data[f"y_{k}"].astype(int)) for k in range(len(persons))]
    decoded = {}
    for person in np.unique(persons):
        model = trained([trial for trial, who in zip(trials, persons, strict=True) if who != person])
        for k in np.flatnonzero(persons == person):
            decoded[f"y_{k}"] = model.predict(trials[k][0])
    np.savez(sys.argv[2], **decoded)


if __name__ == "__main__":
    main()
