"""What the commands share: exit codes, options, progress, tables."""
