"""Evidence for the statements of the documentation. It is not shipped."""
