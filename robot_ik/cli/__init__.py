"""The command line: thin commands that parse, call one job and print (table: ``main.ROWS``)."""
