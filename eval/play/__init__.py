"""Play with a policy: a live episode without an end, and the page that shows it."""
