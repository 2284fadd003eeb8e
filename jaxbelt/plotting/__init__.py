"""Pictures. Matplotlib is imported here only, and no numerics import this folder."""
