"""Programs that make templates, rigs, and generated shapes with known correspondence."""
