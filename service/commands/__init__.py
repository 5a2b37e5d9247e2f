"""The commands of the service: up, api, worker, keys, tenants, backup ..."""
