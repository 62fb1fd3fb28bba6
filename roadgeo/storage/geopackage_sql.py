"""The SQL of a GeoPackage: its tables, QGIS's tables of styles, and the triggers that keep spatial indexes true."""

__all__ = ["RTREE_TRIGGERS", "SCHEMA", "STYLES_SCHEMA"]

SCHEMA = """
PRAGMA application_id = 0x47504B47;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (
    srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
    table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
    last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
    CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
    table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
    z TINYINT NOT NULL, m TINYINT NOT NULL,
    CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
    CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
    CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_extensions (
    table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL, scope TEXT NOT NULL,
    CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
INSERT INTO gpkg_spatial_ref_sys VALUES
    ('Undefined Cartesian SRS', -1, 'NONE', -1, 'undefined', 'undefined Cartesian coordinate reference system'),
    ('Undefined geographic SRS', 0, 'NONE', 0, 'undefined', 'undefined geographic coordinate reference system');
"""

STYLES_SCHEMA = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
    f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')));
INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', 'layer_styles');
"""

_PUT = """INSERT OR REPLACE INTO "rtree_{t}_geom" VALUES (
    NEW."fid", ST_MinX(NEW."geom"), ST_MaxX(NEW."geom"), ST_MinY(NEW."geom"), ST_MaxY(NEW."geom"));"""
_DROP = 'DELETE FROM "rtree_{t}_geom" WHERE id = OLD."fid";'
_DROP_BOTH = 'DELETE FROM "rtree_{t}_geom" WHERE id IN (OLD."fid", NEW."fid");'
_HAS_GEOMETRY = '(NEW."geom" NOTNULL AND NOT ST_IsEmpty(NEW."geom"))'
_HAS_NONE = '(NEW."geom" ISNULL OR ST_IsEmpty(NEW."geom"))'
_STAYS, _MOVES = 'OLD."fid" = NEW."fid" AND ', 'OLD."fid" != NEW."fid" AND '

# As the GeoPackage standard has them (annex F.3); a writer that edits the layer keeps the index true through them.
RTREE_TRIGGERS = "".join(
    f'CREATE TRIGGER "rtree_{{t}}_geom_{name}" AFTER {event} ON "{{t}}" WHEN {when}\nBEGIN\n  {steps}\nEND;\n'
    for name, event, when, steps in (
        ("insert", "INSERT", _HAS_GEOMETRY, _PUT),
        ("update1", 'UPDATE OF "geom"', _STAYS + _HAS_GEOMETRY, _PUT),
        ("update2", 'UPDATE OF "geom"', _STAYS + _HAS_NONE, _DROP),
        ("update3", "UPDATE", _MOVES + _HAS_GEOMETRY, _DROP + _PUT),
        ("update4", "UPDATE", _MOVES + _HAS_NONE, _DROP_BOTH),
        ("delete", "DELETE", 'OLD."geom" NOTNULL', _DROP),
    )
)
