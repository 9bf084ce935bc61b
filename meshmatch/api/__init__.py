"""The Python interface: one typed function for each command, exported by `import meshmatch`."""
