"""What the gate, the supervisor and the witness catch, how soon, and how often for nothing."""
