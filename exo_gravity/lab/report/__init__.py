"""What the tools show: reports of trials, figures, pages and clips."""
