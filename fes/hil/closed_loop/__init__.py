"""The closed loop on a virtual patient: in real time as processes, or in one process and faster."""
