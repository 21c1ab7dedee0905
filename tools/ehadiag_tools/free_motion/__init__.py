"""How the monitor does on free motion: false alarms in hours of it, and delays to true ones."""
