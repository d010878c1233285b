"""How well it agrees: with references, with a truth, with an earlier log, with what was delivered."""
