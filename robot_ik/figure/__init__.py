"""The moving figure: it sees a ball, decides, and reaches, bends, jumps or walks."""
