"""Objects: parametric stand-ins for the YCB objects, import of real meshes, surface points."""
