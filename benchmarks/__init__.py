"""What is measured, on recordings and simulated people; the tables are kept in ``results/`` and shown in docs/.

- ``lib/``: sets of recordings, walkers, judges of swings, the command line, kept figures and their pages
- ``accuracy/``: phases, strides, clearance, orientation against truth; one table beside other libraries
- ``loop/``: stimulation in closed loop: tuning, radios, predicted onset, the virtual patient
- ``safety/``: the gate, the witness, disorder, exchanged feet, fault campaigns
- ``speed/``: how fast and how large, beside other libraries
- ``peers/``: other libraries on the same recordings, in an environment of their own

Each command says what it measures with ``--help``; ``--json FILE`` keeps its tables. Recordings lie in $FES_DATA.
"""
