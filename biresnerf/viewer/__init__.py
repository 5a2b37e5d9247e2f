"""What people see of a result: report.html, and the widgets it shares with the service's page (TypeScript)."""
