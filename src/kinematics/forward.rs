//! From joints to the tip: forward kinematics and the geometric Jacobian.

use nalgebra::{
    Isometry3, Matrix3, Matrix6xX, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6,
};

use super::chain::{Chain, JointKind};

/// One joint as forward kinematics sees it, in a frame turned so that its axis is z: turning about
/// z only mixes two columns of the rotation matrix.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Link {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    prismatic: bool,
    /// It is at `multiplier` times the position of this joint plus `offset`: 1 and 0 for a joint of its own.
    joint: usize,
    multiplier: f64,
    offset: f64,
}

impl Link {
    pub(super) fn new(
        previous_from_link: &Isometry3<f64>,
        kind: JointKind,
        joint: usize,
        multiplier: f64,
        offset: f64,
    ) -> Self {
        Self {
            joint,
            multiplier,
            offset,
            rotation: previous_from_link.rotation.to_rotation_matrix().into_inner(),
            translation: previous_from_link.translation.vector,
            prismatic: kind == JointKind::Prismatic,
        }
    }
}

/// Position and rotation of a frame in the base.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub(super) rotation: Matrix3<f64>,
    pub(super) position: Vector3<f64>,
}

impl Frame {
    pub(super) fn isometry(&self) -> Isometry3<f64> {
        let rotation = Rotation3::from_matrix_unchecked(self.rotation);
        Isometry3::from_parts(
            Translation3::from(self.position),
            UnitQuaternion::from_rotation_matrix(&rotation),
        )
    }
}

impl Chain {
    /// The tip in the base frame when the joints are at `q` (rad, or m for prismatic joints).
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn forward(&self, q: &[f64]) -> Isometry3<f64> {
        self.assert_dof(q);
        self.tip(q, |_, _| ()).isometry()
    }

    /// The tip in the base frame, and the geometric Jacobian there, shape `[6, joints]`: the tip's
    /// velocity (m/s), then its angular velocity (rad/s), both in the base frame, per unit of each
    /// joint's velocity.
    ///
    /// # Panics
    /// When `q` has not one value per joint.
    pub fn jacobian(&self, q: &[f64]) -> (Isometry3<f64>, Matrix6xX<f64>) {
        self.assert_dof(q);
        let mut columns = vec![Vector6::zeros(); self.dof()];
        let tip = self.tip_and_jacobian(q, &mut columns);
        (tip.isometry(), Matrix6xX::from_columns(&columns))
    }

    /// [`Chain::jacobian`] into `columns`, one per joint; without allocating where no joint follows another.
    #[inline]
    pub(super) fn tip_and_jacobian(&self, q: &[f64], columns: &mut [Vector6<f64>]) -> Frame {
        if self.links.len() == columns.len() {
            return self.tip_and_columns(q, columns);
        }
        let mut each = vec![Vector6::zeros(); self.links.len()];
        let tip = self.tip_and_columns(q, &mut each);
        columns.fill(Vector6::zeros());
        for (column, link) in each.iter().zip(&self.links) {
            columns[link.joint] += column * link.multiplier;
        }
        tip
    }

    /// The tip, and what each link's motion makes of it.
    #[inline]
    fn tip_and_columns(&self, q: &[f64], columns: &mut [Vector6<f64>]) -> Frame {
        // First each joint's axis and origin; the columns need the tip, known only at the end.
        let tip = self.tip(q, |joint, frame| {
            let (axis, origin) = (frame.rotation.column(2), frame.position);
            columns[joint] =
                Vector6::new(axis[0], axis[1], axis[2], origin[0], origin[1], origin[2]);
        });
        for (column, link) in columns.iter_mut().zip(&self.links) {
            let axis = Vector3::new(column[0], column[1], column[2]);
            let origin = Vector3::new(column[3], column[4], column[5]);
            let (linear, angular) = if link.prismatic {
                (axis, Vector3::zeros())
            } else {
                (axis.cross(&(tip.position - origin)), axis)
            };
            *column = Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z);
        }
        tip
    }

    /// The frames of what the joints move, in the base frame and turned so that each joint's axis is z.
    pub(super) fn bodies(&self, q: &[f64], bodies: &mut Vec<Frame>) {
        bodies.clear();
        self.walk(q, |_, _| (), |frame| bodies.push(*frame));
    }

    /// The tip; `visit` sees each joint's frame on the way.
    #[inline]
    fn tip(&self, q: &[f64], visit: impl FnMut(usize, &Frame)) -> Frame {
        self.walk(q, visit, |_| ())
    }

    /// The tip; `before` sees each joint's frame on the way, and `after` the same once the joint has moved it.
    #[inline]
    fn walk(
        &self,
        q: &[f64],
        mut before: impl FnMut(usize, &Frame),
        mut after: impl FnMut(&Frame),
    ) -> Frame {
        let mut frame = Frame { rotation: Matrix3::identity(), position: Vector3::zeros() };
        for (joint, link) in self.links.iter().enumerate() {
            let value = link.multiplier * q[link.joint] + link.offset;
            frame.position += frame.rotation * link.translation;
            frame.rotation *= link.rotation;
            before(joint, &frame);
            if link.prismatic {
                frame.position += frame.rotation.column(2) * value;
            } else {
                let (sin, cos) = value.sin_cos();
                let (x, y) =
                    (frame.rotation.column(0).into_owned(), frame.rotation.column(1).into_owned());
                frame.rotation.set_column(0, &(x * cos + y * sin));
                frame.rotation.set_column(1, &(y * cos - x * sin));
            }
            after(&frame);
        }
        let (rotation, translation) = &self.last_link_from_tip;
        frame.position += frame.rotation * translation;
        frame.rotation *= rotation;
        frame
    }
}
