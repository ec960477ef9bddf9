"""The testbed: front ends that show robots and, later, the session behind them."""
