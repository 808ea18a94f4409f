"""Thousands of iterations of one attack, watched for growth and drift."""
