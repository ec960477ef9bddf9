"""The experiments of the theses as data: courses of Aho (2000), table 4.1 of Šimunić (2012)."""
