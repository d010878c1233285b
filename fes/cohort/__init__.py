"""Thousands of recordings at once: found, analysed by many processes, kept as one data set, shown as one page."""
