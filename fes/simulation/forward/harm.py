"""What stimulation can do to a person, counted from the virtual patient's own truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fes.simulation.forward.walker import VirtualStride

EARLY_SHARE: Final = 0.1  # of the push-off's work, taken up by the stimulated dorsiflexors: the burst came too early
INVERTED_RAD: Final = math.radians(5.0)  # at contact: the outer edge is landed on, the ankle may be sprained
SPASM: Final = 0.5  # of the greatest spasm


@dataclass(frozen=True, slots=True)
class Harm:
    """Counts of strides, and means over them; what of it is the patient's own only a walk without stimulation tells."""

    strides: int
    stumbles: int  # the toe caught, and the step was cut short
    drags: int  # the forefoot touched the ground between 25 % and 90 % of the swing, for over 20 ms
    early_bursts: int  # stimulation took more than EARLY_SHARE of the push-off's work
    inverted_contacts: int  # inverted by more than INVERTED_RAD
    spasms: int  # the calf answered with a spasm to being stretched in swing, as by a burst that rises too fast
    push_off_lost: float  # share of the calf's work in all push-offs that stimulation took
    co_contraction_nms: float  # mean impulse a stride of dorsiflexors and calf against each other, N·m·s
    charge_uc: float  # mean a stride


def harm_of(strides: Sequence[VirtualStride]) -> Harm:
    """Count over one foot's strides; all zero for none."""
    count = len(strides)
    pushed_j = sum(one.push_off_j for one in strides)
    return Harm(
        strides=count,
        stumbles=sum(one.stumbled for one in strides),
        drags=sum(one.dragged for one in strides),
        early_bursts=sum(one.opposed_j > EARLY_SHARE * one.push_off_j for one in strides),
        inverted_contacts=sum(one.inversion_at_contact_rad > INVERTED_RAD for one in strides),
        spasms=sum(one.spasm > SPASM for one in strides),
        push_off_lost=sum(one.opposed_j for one in strides) / pushed_j if pushed_j > 0.0 else 0.0,
        co_contraction_nms=sum(one.co_contraction_nms for one in strides) / max(count, 1),
        charge_uc=sum(one.charge_uc for one in strides) / max(count, 1),
    )
