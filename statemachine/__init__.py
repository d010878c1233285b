"""The four gait phases of a foot and the six transitions between them.

**What a gait phase is.** A foot that walks goes round a cycle. It carries the body (*stance*). Its heel rises while
the toes push off (*pre-swing*). It travels through the air (*swing*). It touches the ground and comes down to flat
(*loading response*). Stimulation is given in some phases and must not be given in others, so the phase has to be
known while it lasts, from what one sensor on the foot feels: how the foot turns about its mediolateral axis, and how
the force on it jumps.

**Six transitions** lead from phase to phase (Negård et al. 2005, Figure 5), and there is no other way:

    STANCE ── T1 heel rise ──► PRE_SWING ── T2 foot off ──► SWING
      ▲ ▲ ▲                        │                         │ │
      │ │ └───── T5 put back ──────┘                         │ │
      │ └─────── T6 at rest without a contact ───────────────┘ │
      └── T4 foot flat ── LOADING_RESPONSE ◄── T3 contact ─────┘

A usual stride is T1, T2, T3, T4. T5 and T6 lead back from what was no step, or from a contact that nobody felt. Where
two guards that leave a phase hold at one sample, the transition with the lower number goes. A foot begins in stance,
and begins there anew after its sensor was silent for more than 0.25 s.

**A guard** decides at each sample whether its transition goes. It is a function of what is seen of the foot now
(`Features`), and of this person's measures and limits that are shares of them (`Thresholds`). It is written once and
used three times. The estimation core compiles it and asks it at every sample. When it holds in a session, live or
replayed, the machine of the library `transitions`, which has the phase, asks the plain function again, and stops
everything if that one refuses. (`fes.analyse` takes the compiled core's word, and only sees that each transition leaves
the phase in which the foot was.) And `fes explain` and the report call it with numbers that note what is done with
them, which gives every comparison with both its sides.

**Where the paper is departed from, and why.** Its limits are constants of one sensor at 500 Hz, and it waits for
movement and rest of both accelerometer and gyroscope.

- *Limits are shares* of this person's own push-off, swing, loading response and jolt of contact, and looks back are
  times: one setting is for who hurries and who shuffles, at every sampling rate. The measures follow the strides. How
  long a swing or a loading response may last is told by this person's own: who is slow stands longer and need not
  swing longer. (Before the first one the usual share of the stride stands in.)
- *T1 by how far the foot has turned* since it stood still, for a foot rolls on all through stance.
- *T2 by the derivative.* The paper's text waits until the rotation changes sign, some 60 ms after foot off; its formula
  until the derivative is negative, which is right. `swing_at_reversal` asks for the text's rule.
- *T3 only after mid-swing, and without a jolt too*: foot off jolts as well, and so does a toe that scuffs, at the full
  speed of the swing; a soft contact does not.
- *T4 by the pitch*, for a brisk walker's foot never comes to rest. One that lands on its toes comes to flat from below.
- *T5 and T6 by a rest that lasts*, for a slow swing halts above the ground before it lands.
- *A foot that is dragged or carried*, by weakness or by stimulation, has no push-off: T1 and T2 know it by its turn
  toe-up.

Read on in `phases.py` (the names), `guards.py` (the rules), `table.py` (which guard leads where), `machine.py` (who has
the phase) and `terms.py` (how a guard is explained).
"""
