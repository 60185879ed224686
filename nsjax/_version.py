"""The version: of the package's metadata, of `nsjax --version` and of files that nsjax writes."""

__version__ = "0.1.0"
