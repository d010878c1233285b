"""Measured claims: every figure of docs/ comes from a script here, and each says its own command line."""
