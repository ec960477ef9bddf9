"""The experiments of the theses that this project comes from, repeated: A00's courses and S12's table."""
