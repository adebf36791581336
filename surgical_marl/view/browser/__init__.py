"""The viewer: an environment in a browser, by viser."""
