"""The timing workbench: marks, what they are held against, the baseline file, and the judgement."""
