"""Design-rule checks of masks, their report and files for KLayout."""
