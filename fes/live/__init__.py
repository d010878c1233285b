"""The live session: one loop, one poll, explicit states; what it needs of devices is handed to it."""
