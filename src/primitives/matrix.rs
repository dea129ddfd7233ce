//! A matrix in a file: its rows. What is read can't claim more values than it has, as a stored
//! number of rows and columns could.

use nalgebra::DMatrix;
use serde::de::{Deserialize, Deserializer, Error};
use serde::ser::Serializer;

pub(super) fn serialize<S: Serializer>(
    matrix: &DMatrix<f64>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(matrix.row_iter().map(|row| row.iter().copied().collect::<Vec<_>>()))
}

pub(super) fn deserialize<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<DMatrix<f64>, D::Error> {
    let rows = Vec::<Vec<f64>>::deserialize(deserializer)?;
    let columns = rows.first().map_or(0, Vec::len);
    match rows.iter().find(|row| row.len() != columns) {
        Some(row) => {
            let found = row.len();
            Err(D::Error::custom(format!("a matrix has rows of {columns} and of {found} values")))
        }
        None => Ok(DMatrix::from_row_iterator(rows.len(), columns, rows.into_iter().flatten())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<DMatrix<f64>, String> {
        deserialize(&mut serde_json::Deserializer::from_str(text)).map_err(|e| e.to_string())
    }

    #[test]
    fn a_matrix_is_stored_by_rows_and_rows_are_of_one_length() {
        let matrix = DMatrix::from_row_slice(2, 3, &[1.0, 2.0, 3.0, 4.0, 5.0, 0.1]);
        let mut bytes = Vec::new();
        serialize(&matrix, &mut serde_json::Serializer::new(&mut bytes)).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        assert_eq!(text, "[[1.0,2.0,3.0],[4.0,5.0,0.1]]");
        assert_eq!(read(&text).unwrap(), matrix);
        assert_eq!(read("[[],[]]").unwrap().shape(), (2, 0));
        let error = read("[[1.0],[2.0,3.0]]").unwrap_err();
        assert!(error.contains("a matrix has rows of 1 and of 2 values"), "{error}");
    }
}
