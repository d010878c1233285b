"""What the rooms share: kept figures and their pages, command lines, sets of recordings, judges of swings."""
