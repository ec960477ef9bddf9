"""Front ends of the testbed: the page, MuJoCo's window, the recorder."""
