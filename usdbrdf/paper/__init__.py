"""The tables and figures of B. Haefner et al. 2021 for two assets of one scene, by one command."""
