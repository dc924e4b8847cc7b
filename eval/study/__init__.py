"""Studies: a file names trainings, evaluations and tables; ``xreset study FILE`` does what is missing of them."""
