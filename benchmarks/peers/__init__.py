"""Peers in the accuracy table: cases out, results in, each library in an environment of its own."""
