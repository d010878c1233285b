"""gaitmap with the defaults of its documentation, on the cases in a folder; runs in the peers' environment.

.venv-peers/bin/python benchmarks/peers/run_gaitmap.py FOLDER
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from exchange import Arrays, Case, Method, run_all
from gaitmap.event_detection import HerzerEventDetection, RamppEventDetection
from gaitmap.preprocessing.sensor_alignment import align_dataset_to_gravity
from gaitmap.stride_segmentation import BarthDtw
from gaitmap.trajectory_reconstruction import (
    ForwardBackwardIntegration,
    MadgwickAHRS,
    RegionLevelTrajectory,
    RtsKalman,
    StrideLevelTrajectory,
)
from gaitmap.utils.consts import SF_ACC, SF_GYR
from gaitmap.utils.coordinate_conversion import convert_left_foot_to_fbf, convert_right_foot_to_fbf
from gaitmap.zupt_detection import AredZuptDetector, NormZuptDetector, ShoeZuptDetector


def frame_of(case: Case) -> pd.DataFrame:
    """The samples as gaitmap takes them: m/s² and °/s in its foot sensor frame, aligned to gravity by itself.

    Its alignment needs 0.7 s of stillness; where there is none the samples stay as they came.
    """
    frame = pd.DataFrame(np.hstack((case.acc_mps2, np.degrees(case.gyr_radps))), columns=[*SF_ACC, *SF_GYR])
    try:
        return align_dataset_to_gravity(frame, case.rate_hz)
    except ValueError:
        return frame


def stride_list(borders: np.ndarray) -> pd.DataFrame:
    """A list of strides from mid-stance to mid-stance; only the borders are known."""
    first, last = np.asarray(borders).T
    strides = pd.DataFrame({"s_id": np.arange(len(first)), "start": first, "end": last, "min_vel": first})
    return strides.assign(ic=np.nan, tc=np.nan, pre_ic=np.nan).set_index("s_id")


def measured(positions: pd.DataFrame, count: int) -> Arrays:
    """Length and lift (m) per stride; NaN for strides that gaitmap left out."""
    length, lift = np.full(count, np.nan), np.full(count, np.nan)
    for stride, rows in positions.groupby(level="s_id"):
        xyz = rows[["pos_x", "pos_y", "pos_z"]].to_numpy()
        length[int(stride)] = np.hypot(*(xyz[-1] - xyz[0])[:2])
        lift[int(stride)] = (xyz[:, 2] - xyz[0, 2]).max()
    return {"length_m": length, "lift_m": lift}


def rts_kalman(case: Case, strides: pd.DataFrame) -> pd.DataFrame:
    """Its Kalman smoother over the whole stretch from the first border on, cut into strides."""
    region = pd.DataFrame({"start": [int(strides["start"].min())], "end": [len(case.acc_mps2)]})
    region.index.name = "roi_id"
    wrapper = RegionLevelTrajectory(ori_method=None, pos_method=None, trajectory_method=RtsKalman())
    return wrapper.estimate_intersect(
        frame_of(case), regions_of_interest=region, stride_event_list=strides, sampling_rate_hz=case.rate_hz
    ).position_


def integrated(case: Case, strides: pd.DataFrame) -> pd.DataFrame:
    """Its default, stride by stride: gyroscope integration, forward-backward integration of the force."""
    wrapper = StrideLevelTrajectory()
    return wrapper.estimate(frame_of(case), stride_event_list=strides, sampling_rate_hz=case.rate_hz).position_


def madgwick(case: Case, strides: pd.DataFrame) -> pd.DataFrame:
    """The same with its Madgwick filter for the orientation."""
    wrapper = StrideLevelTrajectory(ori_method=MadgwickAHRS(), pos_method=ForwardBackwardIntegration())
    return wrapper.estimate(frame_of(case), stride_event_list=strides, sampling_rate_hz=case.rate_hz).position_


def detected(case: Case, detector):
    """Its own strides and events: dynamic time warping (Barth), then an event detection."""
    to_body = convert_left_foot_to_fbf if case.side == "left" else convert_right_foot_to_fbf
    body = to_body(frame_of(case))
    segmented = BarthDtw().segment(body, sampling_rate_hz=case.rate_hz).stride_list_
    return detector.detect(data=body, stride_list=segmented, sampling_rate_hz=case.rate_hz)


def pipeline(detector, trajectory):
    """From samples to stride lengths, nothing given."""

    def run(case: Case) -> Arrays:
        numbered = detected(case, detector()).min_vel_event_list_.reset_index(drop=True)
        if len(numbered) == 0:
            raise ValueError("its segmentation finds no stride")
        numbered.index.name = "s_id"
        borders = numbered[["start", "end"]].to_numpy()
        return {"borders": borders, **measured(trajectory(case, numbered), len(borders))}

    return run


def events(detector):
    """Initial contacts and foot offs (s from the start)."""

    def run(case: Case) -> Arrays:
        found = detected(case, detector()).annotated_original_event_list_
        names = (("IC", "ic"), ("FO", "tc"))
        return {name: found[column].dropna().to_numpy(float) / case.rate_hz for name, column in names}

    return run


def rest(case: Case, detector) -> Arrays:
    """Where the foot rests, per sample."""
    return {"rest": detector.detect(frame_of(case), sampling_rate_hz=case.rate_hz).per_sample_zupts_}


def at_borders(trajectory):
    """Strides between given borders."""

    def run(case: Case) -> Arrays:
        return measured(trajectory(case, stride_list(case.borders)), len(case.borders))

    return run


def closure(case: Case) -> Arrays:
    """Where the whole recording ends, from where it begins (m)."""
    region = pd.DataFrame({"start": [0], "end": [len(case.acc_mps2)]})
    region.index.name = "roi_id"
    wrapper = RegionLevelTrajectory(ori_method=None, pos_method=None, trajectory_method=RtsKalman())
    found = wrapper.estimate(frame_of(case), regions_of_interest=region, sampling_rate_hz=case.rate_hz).position_
    xyz = found[["pos_x", "pos_y", "pos_z"]].to_numpy()
    return {"end_m": xyz[-1] - xyz[0]}


METHODS = [
    Method("gaitmap RtsKalman", "borders", "off-line", at_borders(rts_kalman)),
    Method("gaitmap RtsKalman, our ends", "our ends", "off-line", at_borders(rts_kalman)),
    Method("gaitmap default integration, our ends", "our ends", "causal", at_borders(integrated)),
    Method("gaitmap default integration", "borders", "causal", at_borders(integrated)),
    Method("gaitmap Madgwick, forward-backward", "borders", "causal", at_borders(madgwick)),
    Method(
        "gaitmap pipeline (Rampp), default integration",
        "detection",
        "off-line",
        pipeline(RamppEventDetection, integrated),
    ),
    Method("gaitmap pipeline (Herzer), RtsKalman", "detection", "off-line", pipeline(HerzerEventDetection, rts_kalman)),
    Method("gaitmap Barth DTW, Rampp", "events", "off-line", events(RamppEventDetection)),
    Method("gaitmap Barth DTW, Herzer", "events", "off-line", events(HerzerEventDetection)),
    Method("gaitmap NormZuptDetector", "rest", "off-line", lambda case: rest(case, NormZuptDetector())),
    Method("gaitmap ShoeZuptDetector", "rest", "off-line", lambda case: rest(case, ShoeZuptDetector())),
    Method("gaitmap AredZuptDetector", "rest", "off-line", lambda case: rest(case, AredZuptDetector())),
    Method("gaitmap RtsKalman", "closure", "off-line", closure),
]

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    run_all(Path(sys.argv[1]), METHODS)
