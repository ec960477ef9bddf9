"""Pictures that are computed, with known truth."""
