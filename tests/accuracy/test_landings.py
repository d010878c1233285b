"""The walks of ``benchmarks/accuracy/landings.py`` are what they say, and foot flat is told of them."""

import numpy as np
import pytest

from benchmarks.accuracy.landings import LANDINGS, judge, walk


@pytest.mark.parametrize("landing", LANDINGS)
def test_a_foot_lands_as_it_is_called_and_its_flat_is_told(landing: str) -> None:
    made = walk(landing, "brisk", 0)
    loading_s = np.array(made.flat_s) - made.contact_s
    assert (loading_s >= 0.0).all()
    if landing != "flat":
        rate = made.track.gyr_radps
        main = rate[:, np.argmax(np.abs(rate).sum(axis=0))]
        rate_hz = made.track.rate_hz
        spans = zip(made.contact_s, loading_s, strict=True)
        turns = [main[round(at * rate_hz) : round((at + for_s) * rate_hz)].sum() for at, for_s in spans]
        push = [main[round((r - 0.02) * rate_hz) : round((r + 0.1) * rate_hz)].sum() for r in made.rise_s]
        # from the heel it comes down as a push-off turns, from the toes the other way
        assert np.sign(np.median(turns) * np.median(push)) == (1 if landing == "heel" else -1)
    told = judge(made)
    assert told.refused == 0
    assert len(told.t4) == len(made.flat_s)
    assert abs(np.median(told.t4)) <= 30.0
    assert 0.0 <= np.median(told.t1) <= 40.0
