"""HASOMED ScienceMode2 and ScienceMode4: framing, codecs, ports."""
