"""The Debian package: what builds it, and its maintainer's scripts."""
