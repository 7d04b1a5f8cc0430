// Planes and object clusters with PCL, timed: the pipelines of PCL's own tutorials.
//
// usage: pcl_detection CLOUDS REPEATS
// CLOUDS holds frames: int32 width, int32 height, float32 up[3], then width * height * 3 float32
// (NaN: no depth).
// Prints a line per frame and method: method, frame, milliseconds of CPU time (the best of REPEATS),
// number of clusters.
#include <pcl/ModelCoefficients.h>
#include <pcl/features/integral_image_normal.h>
#include <pcl/features/normal_3d.h>
#include <pcl/filters/passthrough.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/sample_consensus/method_types.h>
#include <pcl/sample_consensus/model_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/euclidean_cluster_comparator.h>
#include <pcl/segmentation/extract_clusters.h>
#include <pcl/segmentation/organized_connected_component_segmentation.h>
#include <pcl/segmentation/organized_multi_plane_segmentation.h>
#include <pcl/segmentation/sac_segmentation.h>

#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <functional>
#include <vector>

using Point = pcl::PointXYZ;
using Cloud = pcl::PointCloud<Point>;

static double cpu_ms() {
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec * 1e3 + t.tv_nsec * 1e-6;
}

// Thesis ch. 4: pass-through at 2 m, 1 cm voxels, normals, horizontal points, plane candidates by
// Euclidean clustering, RANSAC for each, Euclidean clusters of what lies above the largest.
static int unorganized(const Cloud::Ptr& input, const Eigen::Vector3f& up) {
  Cloud::Ptr near(new Cloud), voxels(new Cloud), flat(new Cloud), rest(new Cloud);
  pcl::PassThrough<Point> pass;
  pass.setInputCloud(input);
  pass.setFilterFieldName("z");
  pass.setFilterLimits(0.f, 2.f);
  pass.filter(*near);
  pcl::VoxelGrid<Point> grid;
  grid.setInputCloud(near);
  grid.setLeafSize(.01f, .01f, .01f);
  grid.filter(*voxels);
  pcl::search::KdTree<Point>::Ptr tree(new pcl::search::KdTree<Point>);
  pcl::PointCloud<pcl::Normal> normals;
  pcl::NormalEstimation<Point, pcl::Normal> estimate;
  estimate.setInputCloud(voxels);
  estimate.setSearchMethod(tree);
  estimate.setKSearch(20);
  estimate.compute(normals);
  for (std::size_t i = 0; i < voxels->size(); ++i)
    if (std::abs(normals[i].getNormalVector3fMap().dot(up)) > .95f) flat->push_back((*voxels)[i]);
  if (flat->empty()) return 0;
  std::vector<pcl::PointIndices> candidates;
  pcl::search::KdTree<Point>::Ptr flat_tree(new pcl::search::KdTree<Point>);
  flat_tree->setInputCloud(flat);
  pcl::EuclideanClusterExtraction<Point> cluster;
  cluster.setClusterTolerance(.03);
  cluster.setMinClusterSize(200);
  cluster.setSearchMethod(flat_tree);
  cluster.setInputCloud(flat);
  cluster.extract(candidates);
  std::size_t largest = 0;
  Eigen::Vector4f best(0, 0, 0, 0);
  for (const auto& candidate : candidates) {
    pcl::SACSegmentation<Point> plane;
    pcl::PointIndices inliers;
    pcl::ModelCoefficients model;
    plane.setOptimizeCoefficients(true);
    plane.setModelType(pcl::SACMODEL_PLANE);
    plane.setMethodType(pcl::SAC_RANSAC);
    plane.setMaxIterations(200);
    plane.setDistanceThreshold(.01);
    plane.setInputCloud(flat);
    plane.setIndices(pcl::make_shared<pcl::PointIndices>(candidate));
    plane.segment(inliers, model);
    if (inliers.indices.size() <= largest) continue;
    largest = inliers.indices.size();
    best = Eigen::Vector4f(model.values[0], model.values[1], model.values[2], model.values[3]);
  }
  if (largest == 0) return 0;
  const float side = best[3] > 0 ? 1.f : -1.f;  // the sensor is above the plane
  for (const auto& p : *voxels) {
    const float height = side * (best[0] * p.x + best[1] * p.y + best[2] * p.z + best[3]);
    if (height > .01f && height < .6f) rest->push_back(p);
  }
  if (rest->empty()) return 0;
  pcl::search::KdTree<Point>::Ptr rest_tree(new pcl::search::KdTree<Point>);
  rest_tree->setInputCloud(rest);
  std::vector<pcl::PointIndices> clusters;
  cluster.setClusterTolerance(.02);
  cluster.setMinClusterSize(30);
  cluster.setSearchMethod(rest_tree);
  cluster.setInputCloud(rest);
  cluster.extract(clusters);
  return static_cast<int>(clusters.size());
}

// Integral-image normals, multi-plane segmentation, connected components of the rest.
static int organized(const Cloud::Ptr& input, bool covariance) {
  pcl::PointCloud<pcl::Normal>::Ptr normals(new pcl::PointCloud<pcl::Normal>);
  pcl::IntegralImageNormalEstimation<Point, pcl::Normal> estimate;
  estimate.setNormalEstimationMethod(covariance ? estimate.COVARIANCE_MATRIX
                                                : estimate.AVERAGE_3D_GRADIENT);
  estimate.setMaxDepthChangeFactor(.02f);
  estimate.setNormalSmoothingSize(10.f);
  estimate.setInputCloud(input);
  estimate.compute(*normals);
  pcl::OrganizedMultiPlaneSegmentation<Point, pcl::Normal, pcl::Label> planes;
  planes.setMinInliers(5000);
  planes.setAngularThreshold(.05);
  planes.setDistanceThreshold(.02);
  planes.setInputNormals(normals);
  planes.setInputCloud(input);
  std::vector<pcl::PlanarRegion<Point>, Eigen::aligned_allocator<pcl::PlanarRegion<Point>>> regions;
  std::vector<pcl::ModelCoefficients> models;
  std::vector<pcl::PointIndices> inliers, label_indices, boundaries;
  pcl::PointCloud<pcl::Label>::Ptr labels(new pcl::PointCloud<pcl::Label>);
  planes.segmentAndRefine(regions, models, inliers, labels, label_indices, boundaries);
  using Comparator = pcl::EuclideanClusterComparator<Point, pcl::Label>;
  pcl::shared_ptr<Comparator> comparator(new Comparator);
  pcl::shared_ptr<std::set<std::uint32_t>> excluded(new std::set<std::uint32_t>);
  for (std::size_t i = 0; i < label_indices.size(); ++i)
    if (label_indices[i].indices.size() > 5000) excluded->insert(static_cast<std::uint32_t>(i));
  comparator->setInputCloud(input);
  comparator->setLabels(labels);
  comparator->setExcludeLabels(excluded);
  comparator->setDistanceThreshold(.02f, false);
  pcl::PointCloud<pcl::Label> found;
  std::vector<pcl::PointIndices> clusters;
  pcl::OrganizedConnectedComponentSegmentation<Point, pcl::Label> components(comparator);
  components.setInputCloud(input);
  components.segment(found, clusters);
  int objects = 0;
  for (const auto& cluster : clusters) objects += cluster.indices.size() > 300;
  return objects;
}

int main(int argc, char** argv) {
  if (argc < 3) return 2;
  const int repeats = std::atoi(argv[2]);
  std::ifstream file(argv[1], std::ios::binary);
  const std::vector<std::pair<const char*, std::function<int(const Cloud::Ptr&, const Eigen::Vector3f&)>>> methods = {
      {"unorganized", unorganized},
      {"organized_covariance", [](const auto& c, const auto&) { return organized(c, true); }},
      {"organized_gradient", [](const auto& c, const auto&) { return organized(c, false); }},
  };
  std::int32_t size[2];
  for (int frame = 0; file.read(reinterpret_cast<char*>(size), sizeof size); ++frame) {
    Eigen::Vector3f up;
    file.read(reinterpret_cast<char*>(up.data()), sizeof(float) * 3);
    std::vector<float> raw(3u * size[0] * size[1]);
    file.read(reinterpret_cast<char*>(raw.data()), raw.size() * sizeof(float));
    Cloud::Ptr cloud(new Cloud(size[0], size[1]));
    cloud->is_dense = false;
    for (std::size_t i = 0; i < cloud->size(); ++i)
      (*cloud)[i] = Point(raw[3 * i], raw[3 * i + 1], raw[3 * i + 2]);
    for (const auto& [name, run] : methods) {
      if (size[1] == 1 && std::string(name) != "unorganized") continue;
      double best = 1e9;
      int objects = 0;
      for (int k = 0; k < repeats; ++k) {
        const double begun = cpu_ms();
        objects = run(cloud, up);
        best = std::min(best, cpu_ms() - begun);
      }
      std::printf("%s %d %.3f %d\n", name, frame, best, objects);
    }
  }
}
