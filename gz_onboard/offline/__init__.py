"""What the offline commands share: measured rides, parallel work and its progress, results as JSON, text and pages."""
