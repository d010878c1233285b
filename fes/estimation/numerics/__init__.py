"""Numbers under every estimate: compiling, rotations, filters, small linear systems, records."""
