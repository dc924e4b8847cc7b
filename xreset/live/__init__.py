"""Policies in real time: engines as drivers of the runtime's loop, deployment and serving."""
