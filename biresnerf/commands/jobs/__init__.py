"""Commands that speak to a service: submit, status, wait, download ..."""
