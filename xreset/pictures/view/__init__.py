"""Looking at xreset's files: demonstrations, robot trajectories and reset banks, in a browser or as pictures."""
