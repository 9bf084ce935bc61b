"""A page that shows two shapes and the map between them; three.js comes with it (see README.md here)."""
