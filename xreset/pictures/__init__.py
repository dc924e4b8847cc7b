"""Pictures, films and the browser viewer, drawn without any engine, display or GPU."""
