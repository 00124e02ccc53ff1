"""Every picture: of maps (`maps`), and of continuous worlds (`fields`)."""
