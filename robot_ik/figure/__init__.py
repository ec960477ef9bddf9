"""A humanoid figure that decides how to reach a ball, and reaches, bends, jumps or walks."""
