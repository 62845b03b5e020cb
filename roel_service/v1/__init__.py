"""Generated messages and stubs of `roel_service.v1`; made by proto/generate.py."""
