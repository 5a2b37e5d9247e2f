"""Research: comparisons of methods and the paper's studies, with tables and plots. Nothing else imports it."""
