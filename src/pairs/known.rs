//! A table of any size whose information is known: what tests and measurements of large tables read.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use polars::io::parquet::metadata::FileMetadataRef;
use polars::prelude::{
    Column, DataFrame, KeyValueMetadata, NamedFrom as _, ParquetCompression, ParquetWriter, PolarsResult, Series,
};
use rayon::prelude::*;

use super::PairsError;
use crate::io::{self, IoError};
use crate::rng::{self, Seeds};

/// Rows of a row group; each has a stream of its own.
const GROUP: u64 = 1 << 19;
/// Row groups drawn side by side.
const TOGETHER: u64 = 4;
/// Values of a and of b.
const LEVELS: usize = 4;
/// Probability that b is a.
const COPIED: f64 = 0.7;
/// Metadata key of such a table.
const KEY: &str = "ccmarl.known";
/// Names of the columns.
const COLUMNS: [&str; 4] = ["x", "y", "a", "b"];

/// What such a table holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Known {
    /// Rows.
    pub rows: u64,
    /// Correlation of the normal columns x and y.
    pub rho: f64,
    /// Seed.
    pub seed: u64,
}

impl Known {
    /// I(x; y) = −½ ln(1 − ρ²), nats.
    pub fn normal(&self) -> f64 {
        -0.5 * libm::log1p(-self.rho * self.rho)
    }

    /// I(a; b), nats: a is one of four values, all equally likely, and b is a with probability 0.7, else one of the others.
    pub fn discrete() -> f64 {
        let other = (1.0 - COPIED) / (LEVELS - 1) as f64;
        libm::log(LEVELS as f64) + COPIED * libm::log(COPIED) + (1.0 - COPIED) * libm::log(other)
    }

    /// Writes the table as a Parquet file, row group by row group; `done` is told the rows that are written and says whether
    /// to go on. `false` when it did not, and then there is no file.
    ///
    /// # Errors
    /// [`PairsError`].
    pub fn write(&self, path: &Path, done: &mut dyn FnMut(u64) -> bool) -> Result<bool, PairsError> {
        io::create_parent(path)?;
        // a name that nobody else has: `.NAME.partial` may be a recording that `recover` can still put in place
        let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let mut options = tempfile::Builder::new();
        options.prefix(".table.").suffix(".new");
        #[cfg(unix)]
        options.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666)); // less the umask, as of any file
        let built = options.tempfile_in(folder).map_err(IoError::os("create", path))?;
        if !self.write_to(built.as_file(), path, done)? {
            return Ok(false); // dropped, it is gone
        }
        built.persist(path).map_err(|error| IoError::os("put in place", path)(error.error))?;
        Ok(true)
    }

    fn write_to(&self, file: &File, path: &Path, done: &mut dyn FnMut(u64) -> bool) -> Result<bool, PairsError> {
        let unwritten = |error: polars::prelude::PolarsError| {
            let message = error.to_string().lines().next().unwrap_or_default().to_owned();
            IoError::os("write", path)(std::io::Error::other(message))
        };
        let schema = Arc::clone(self.group(0, 0).map_err(unwritten)?.schema());
        let writer = ParquetWriter::new(file).with_compression(ParquetCompression::Uncompressed);
        let key = KeyValueMetadata::from_static(vec![(KEY.to_owned(), String::new())]);
        let writer = writer.with_key_value_metadata(Some(key));
        let mut writer = writer.batched(&schema).map_err(unwritten)?;
        let groups = self.rows.div_ceil(GROUP);
        for first in (0..groups).step_by(TOGETHER as usize) {
            let some = (first..groups.min(first + TOGETHER)).into_par_iter();
            let frames: PolarsResult<Vec<DataFrame>> =
                some.map(|g| self.group(g, (self.rows - g * GROUP).min(GROUP) as usize)).collect();
            for frame in frames.map_err(unwritten)? {
                writer.write_batch(&frame).map_err(unwritten)?;
            }
            if !done((first + TOGETHER).min(groups).saturating_mul(GROUP).min(self.rows)) {
                return Ok(false);
            }
        }
        writer.finish().map_err(unwritten)?;
        file.sync_all().map_err(IoError::os("sync", path))?;
        Ok(true)
    }

    fn group(&self, number: u64, rows: usize) -> PolarsResult<DataFrame> {
        let mut rng = Seeds::new(self.seed).child("known").indexed_stream("group", number);
        let noise = libm::sqrt(1.0 - self.rho * self.rho);
        let (mut x, mut y) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        let (mut a, mut b) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
        for _ in 0..rows {
            let own = rng::normal(&mut rng);
            x.push(own);
            y.push(self.rho * own + noise * rng::normal(&mut rng));
            let value = rng::below(&mut rng, LEVELS);
            let moved = if rng::bernoulli(&mut rng, COPIED) { 0 } else { 1 + rng::below(&mut rng, LEVELS - 1) };
            a.push(value as u8);
            b.push(((value + moved) % LEVELS) as u8);
        }
        let [of_x, of_y, of_a, of_b] = COLUMNS.map(Into::into);
        let columns = vec![
            Column::from(Series::new(of_x, x)),
            Column::from(Series::new(of_y, y)),
            Column::from(Series::new(of_a, a)),
            Column::from(Series::new(of_b, b)),
        ];
        DataFrame::new(rows, columns)
    }
}

/// Whether a file is such a table, by the key in its metadata: anybody's columns may have these names.
pub fn is_known(path: &Path) -> bool {
    use polars::prelude::{ParquetReader, SerReader as _};
    let Ok(file) = File::open(path) else { return false };
    let metadata = io::caught(|| ParquetReader::new(file).get_metadata().cloned());
    let has = |metadata: &FileMetadataRef| metadata.key_value_metadata().iter().flatten().any(|kv| kv.key == KEY);
    metadata.is_some_and(|metadata| metadata.is_ok_and(|metadata| has(&metadata)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pairs::{TableOptions, table};

    #[test]
    fn the_table_has_its_information_and_the_same_bytes_for_the_same_seed() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let known = Known { rows: GROUP + 1000, rho: 0.75, seed: 1 };
        let mut told = Vec::new();
        assert!(
            known
                .write(&at("a.parquet"), &mut |rows| {
                    told.push(rows);
                    true
                })
                .unwrap()
        );
        assert_eq!(told, [known.rows]);
        known.write(&at("b.parquet"), &mut |_| true).unwrap();
        assert_eq!(std::fs::read(at("a.parquet")).unwrap(), std::fs::read(at("b.parquet")).unwrap());
        assert!(is_known(&at("a.parquet")) && !is_known(&at("none")));
        let read = |x: &str, y: &str| {
            let options = TableOptions { x: vec![x.to_owned()], y: vec![y.to_owned()], ..TableOptions::default() };
            table(&at("a.parquet"), &options).unwrap()
        };
        let (normal, n) = (read("x", "y"), known.rows as f64);
        let products = normal.x.data.iter().zip(&normal.y.data).map(|(x, y)| x * y).sum::<f64>() / n;
        assert!((products - 0.75).abs() < 0.007, "{products}");
        assert!((known.normal() - 0.413_339).abs() < 1e-6);
        let discrete = read("a", "b");
        let mut counts = [[0.0; LEVELS]; LEVELS];
        discrete.x.data.iter().zip(&discrete.y.data).for_each(|(&a, &b)| counts[a as usize][b as usize] += 1.0 / n);
        // both margins are uniform
        let seen: f64 = counts.iter().flatten().map(|p| p * (16.0 * p).ln()).sum();
        assert!((seen - Known::discrete()).abs() < 0.005, "{seen} {}", Known::discrete());
        // stopped: nothing is left
        assert!(!known.write(&at("c.parquet"), &mut |_| false).unwrap());
        let mut left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["a.parquet", "b.parquet"]);
    }
    #[test]
    fn what_another_command_left_beside_the_name_stays_and_anybodys_columns_are_not_ours() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.parquet");
        let partial = io::partial_path(&path);
        std::fs::create_dir(&partial).unwrap();
        io::write_atomic(&partial.join("journal"), b"a recording").unwrap();
        let known = Known { rows: 10, rho: 0.5, seed: 1 };
        assert!(!known.write(&path, &mut |_| false).unwrap());
        assert!(known.write(&path, &mut |_| true).unwrap());
        assert_eq!(std::fs::read_to_string(partial.join("journal")).unwrap(), "a recording");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
        assert!(is_known(&path));
        let other = dir.path().join("other.parquet");
        ParquetWriter::new(File::create(&other).unwrap()).finish(&mut known.group(0, 5).unwrap()).unwrap();
        assert!(!is_known(&other));
    }
}
