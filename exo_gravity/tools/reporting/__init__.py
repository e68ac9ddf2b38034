"""What the tools show: reports of trials and torque budgets, as tables, figures and pages."""
