"""Every picture: of maps (`maps`), policies (`policies`) and physical systems (`physics`)."""
