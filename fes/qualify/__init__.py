"""One device qualified: measured, turned by a person or read from an oscilloscope; evidence, and the page of it."""
