"""The command line: thin commands that parse, call one job and print.

``commands`` is the table of commands; each command is one module with a frozen dataclass of options
and ``run(options) -> exit code``.  ``console`` prints and asks.
"""
