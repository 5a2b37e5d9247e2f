"""report.html, and the widgets that it shares with the service's page (TypeScript). No HTTP, no training."""
