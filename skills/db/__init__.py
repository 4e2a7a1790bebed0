"""The database: tables whose rows label values, sessions and transactions, serialisation, and backups.

base             column types and names that all tables share
models           the tables of the library
service_tables   the tables of the service: jobs, workers, keys, sign-ins, events
session          opening the database; sessions and their errors; a full and a failed disk; migrations
packed           values in one column, and the archive format that they are stored in
row_visibility   rules that restrict a caller's queries to some surgeons
changes          change detection for caches, without reading a table
archive          backups
"""
