"""Maps shown live: the browser viewer."""
