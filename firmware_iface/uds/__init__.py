"""UDS (ISO 14229) over ISO-TP (ISO 15765-2): the services of the computer, and a tester's side."""
